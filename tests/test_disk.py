"""Files that Lance wrote, whole and truncated."""

import lance
import pyarrow as pa
import pytest

from ssrvlad_torch.database.disk import check_data, check_deletions

ROWS = 20_000


@pytest.fixture(params=[3, 4096, 5000, 15_000])
def deletions(request, tmp_path):
    """A file of N deleted rows, and what Lance recorded of it."""
    rows = pa.table({"frame": pa.array(range(ROWS))})
    table = lance.write_dataset(rows, tmp_path / "table")
    removed = rows.slice(0, request.param)
    removal = table.merge_insert("frame").when_matched_delete().execute_uncommitted(removed)[0]
    [fragment] = removal.operation.updated_fragments
    assert fragment.deletion_file.num_deleted_rows == request.param
    return tmp_path / "table" / fragment.deletion_file.path(fragment.id), fragment.deletion_file


def test_a_whole_file_is_accepted(deletions):
    check_deletions(*deletions)


@pytest.mark.parametrize("size", [0, 1, 7, 9, 0.5, -1])
def test_a_truncated_file_is_refused(deletions, size):
    path, recorded = deletions
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * size) if isinstance(size, float) else size])
    with pytest.raises(OSError, match="not all was written"):
        check_deletions(path, recorded)


def test_a_truncated_data_file_is_refused(tmp_path):
    rows = pa.table({"frame": pa.array(range(ROWS))})
    [fragment] = lance.fragment.write_fragments(rows, tmp_path)
    [file] = fragment.files
    path = tmp_path / "data" / file.path
    check_data(path, file)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(OSError, match=f"not all was written: '{path}'"):
        check_data(path, file)

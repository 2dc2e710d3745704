"""Files that Lance wrote, whole and truncated."""

import lance
import pyarrow as pa
import pytest

from ssrvlad_torch.database.disk import deleted_rows, flush_fragments

ROWS = 20_000


@pytest.fixture
def rows():
    return pa.table({"frame": pa.array(range(ROWS))})


def assert_truncated(path, content, table, fragment):
    path.write_bytes(content)
    with pytest.raises(OSError, match=f"not all was written: '{path}'"):
        flush_fragments(str(table), [fragment])


@pytest.mark.parametrize("count", [3, 4096, 5000, 15_000])
def test_a_truncated_file_of_deleted_rows_is_refused_a_whole_one_is_not(tmp_path, rows, count):
    table = lance.write_dataset(rows, tmp_path)
    removal = table.merge_insert("frame").when_matched_delete()
    [fragment] = removal.execute_uncommitted(rows.slice(0, count))[0].operation.updated_fragments
    path = tmp_path / fragment.deletion_file.path(fragment.id)
    assert deleted_rows(path) == fragment.deletion_file.num_deleted_rows == count
    flush_fragments(str(tmp_path), [fragment])
    content = path.read_bytes()
    for size in (0, 1, 7, 9, len(content) // 2, -1):
        assert_truncated(path, content[:size], tmp_path, fragment)


def test_a_truncated_data_file_is_refused(tmp_path, rows):
    [fragment] = lance.fragment.write_fragments(rows, tmp_path)
    flush_fragments(str(tmp_path), [fragment])
    path = tmp_path / "data" / fragment.files[0].path
    assert_truncated(path, path.read_bytes()[:-1], tmp_path, fragment)

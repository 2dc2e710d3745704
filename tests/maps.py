"""Folders of label maps and a database of them, for the tests of encoding."""

import torch
from helpers import street, write_street

from ssrvlad_torch import SSRVLAD
from ssrvlad_torch.database.database import Database
from ssrvlad_torch.datasets.label_files import find_label_files
from ssrvlad_torch.encoding.encoder import encode_to_database
from ssrvlad_torch.encoding.results import EncodeOptions

HEAD = SSRVLAD.from_preset("default", labels_as="camvid-11")


class Maps:
    def __init__(self, folder):
        self.folder = folder

    def add(self, sequence, numbers, height=24, width=32):
        for number in numbers:
            write_street(self.folder / sequence / f"{number}.png", number, height, width)

    def files(self, *folders, **options):
        folders = [str(self.folder / folder) for folder in folders or ("[ab]",)]
        return find_label_files(folders, **options)

    def database(self):
        return Database.open_or_create(self.folder / "town.ssrdb", HEAD.config)

    def encode(self, *folders, head=HEAD, sequence=None, map_folders=(), **options):
        files = self.files(*folders, sequence=sequence, map_folders=map_folders)
        return encode_to_database(head, files, self.database(), EncodeOptions(**options))


def alone(labels):
    return HEAD(torch.from_numpy(labels)[None])[0]


def assert_streets(frames, seeds):
    """Asserts that frames have the descriptors of these streets."""
    assert torch.equal(frames.descriptors, torch.stack([alone(street(seed)) for seed in seeds]))


def counts(summary):
    return summary.encoded, summary.already_there, len(summary.skipped)


def rewrite(path, seed):
    """Replaces a label map by another, in a new file."""
    path.unlink()
    write_street(path, seed)

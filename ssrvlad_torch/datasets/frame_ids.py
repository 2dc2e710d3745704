"""The ids of frames: ``<sequence>/<name>``, or a name alone."""


def split_id(frame: str) -> tuple[str, str]:
    """The sequence, empty if there is none, and the name of a frame."""
    sequence, _, name = frame.rpartition("/")
    return sequence, name


def sequence_of(frame: str) -> str:
    """The sequence of a frame, empty if there is none."""
    return split_id(frame)[0]


def name_of(frame: str) -> str:
    """The name of a frame in its sequence."""
    return split_id(frame)[1]

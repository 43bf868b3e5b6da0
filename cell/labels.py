"""What may be the name of an object: looked at before anything is grasped under it."""

from recognition.recognizer import UNKNOWN

LONGEST_LABEL = 200
"""Characters of a label that a data set holds."""


def checked_label(label: str) -> str:
    """Return a label that data sets, models and answers can carry.

    Raises
    ------
    ValueError
        If it is blank, too long, not printable, has space around it, or is the word for what is
        not known.
    """
    if not label.strip() or label != label.strip():
        raise ValueError(f"label {label!r:.60} is blank or has space around it; write a name")
    if len(label) > LONGEST_LABEL:
        raise ValueError(f"a label of {len(label)} characters; at most {LONGEST_LABEL} are kept")
    if not label.isprintable():
        raise ValueError(f"label {label!a:.60} holds characters that cannot be printed")
    if label == UNKNOWN:
        raise ValueError(f"{UNKNOWN} is the answer for what was not taught; choose another label")
    return label

"""What a library said about a file, fit to stand inside one sentence.

Decoders answer with several lines, source positions and whole dictionaries; a person needs the first words.
"""

from __future__ import annotations

LONGEST = 160


def reason(error: BaseException) -> str:
    """The error's text on one line, cut to a readable length; its kind when it says nothing."""
    said = " ".join(str(error).split()) or type(error).__name__
    return said if len(said) <= LONGEST else said[: LONGEST - 1].rstrip() + "…"

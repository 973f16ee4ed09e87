"""What goes wrong because of the input, told to the user in one sentence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class SceneError(ValueError):
    """The input cannot be used; the message says what is wrong, in which file or view, and what to do."""


@contextmanager
def refusals_end_the_program() -> Iterator[None]:
    """Turn a refusal into its sentence on stderr and exit status 1; a bug keeps its traceback."""
    try:
        yield
    except (SceneError, FileNotFoundError) as error:
        raise SystemExit(f"shellgs: {error}") from error

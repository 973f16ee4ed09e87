"""What is in COLMAP's database, looked up while another process may be writing it."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

_HOMOGRAPHIES = (4, 5, 6)  # COLMAP's PLANAR, PANORAMIC, PLANAR_OR_PANORAMIC
_MATCHED = 100  # features, of a pair that shows the same: of others they were 31 at most
NO_PARALLAX = 0.95
"""Share of :func:`flat_pairs`: all of a camera on a tripod, a sixth of a walk along the synthetic facade."""


@contextmanager
def counting(database: Path) -> Iterator[Callable[[str], int]]:
    """What counts the rows of a table, with a condition perhaps, that another process may be writing.

    It keeps one connection: where one ends, SQLite locks the database for a moment, and COLMAP cannot open it.
    """
    kept: list[sqlite3.Connection] = []

    def count(table: str) -> int:
        with suppress(sqlite3.Error):  # does not exist yet, or is busy
            if not kept:
                kept.append(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True))
            return kept[0].execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]
        return 0

    try:
        yield count
    finally:
        for connection in kept:
            connection.close()


def flat_pairs(database: Path) -> float:
    """Share of the pairs that a homography explains: of a turning camera, of a plane, or of a camera that stood."""
    # COLMAP leaves out all matches of what stands at the same pixels.
    pairs = "matches JOIN two_view_geometries AS kept USING (pair_id)"
    with counting(database) as rows:
        counts = {kind: rows(f"two_view_geometries WHERE rows > 0 AND config = {kind}") for kind in range(2, 9)}
        stood = rows(f"{pairs} WHERE matches.rows >= {_MATCHED} AND kept.rows = 0")
    return (stood + sum(counts[kind] for kind in _HOMOGRAPHIES)) / max(1, stood + sum(counts.values()))


def tidy(database: Path) -> None:
    """Let SQLite remove the files that it made beside a database when :func:`counting`, which may not, came last."""
    writing = f"{database.absolute().as_uri()}?mode=rw"
    with suppress(sqlite3.Error), closing(sqlite3.connect(writing, uri=True)) as connection:
        connection.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()


def copied(database: Path, copy: Path) -> Path:
    """A copy of the database."""
    with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)
    return copy

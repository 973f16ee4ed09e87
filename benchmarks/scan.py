"""Read a large scan of a street, and compare with bare decompression of the same file, or bare reading.

The file is written piece by piece. Each measurement is a fresh process, whose peak resident memory is printed (Linux),
with that of the process that decompresses for it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.console import Console

PIECE = 2_000_000
ORIGIN = np.array([410_000.0, 5_413_000.0, 250.0])
Format = Literal["laz", "ply"]
READ = {
    "laz": """
import laspy
with laspy.open(sys.argv[1]) as file:
    for piece in file.chunk_iterator(1_000_000):
        piece.X
""",
    "ply": """
with open(sys.argv[1], "rb") as file:
    while file.read(27 << 20):
        pass
""",
    "merged": """
from shellgs_method.files.surfaces import read_surface
cloud = read_surface(Path(sys.argv[1])).whole
print(f"{cloud.total} points in {len(cloud.points)} voxels of {cloud.voxel:.3g} m")
""",
}
MEASURED = """
import resource, sys, time
from pathlib import Path
start = time.perf_counter()
{code}
seconds = time.perf_counter() - start
usage = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
# Not ru_maxrss of itself, which a process inherits from its parent.
own = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(seconds, sum(u.ru_utime + u.ru_stime for u in usage), own / 1e6, usage[1].ru_maxrss / 1e6)
"""


@dataclass(frozen=True)
class Benchmark:
    """What to read.

    Attributes:
        points: number of points, in millions.
        formats: formats of the file.
        folder: folder of the file, which is removed; None for a temporary one.
    """

    points: float = 200
    formats: tuple[Format, ...] = ("laz", "ply")
    folder: Path | None = None


def street(points: int, seed: int = 0) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points and grey values of a street of 300 m: two rows of houses 12 m high, with recessed windows, and the ground.

    They come house by house, as a scanner passes.
    """
    rng = np.random.default_rng(seed)
    houses = max(1, points // PIECE)
    for house, count in enumerate(np.full(houses, points // houses) + (np.arange(houses) < points % houses)):
        x = rng.uniform(300 * house / houses, 300 * (house + 1) / houses, count)
        z, side = rng.uniform(0, 12, count), rng.integers(0, 3, count)
        window = (x % 3 > 1) & (x % 3 < 2.2) & (z % 3 > 1) & (z % 3 < 2.5)
        y = np.select([side == 0, side == 1], [-7 - 0.25 * window, 7 + 0.25 * window], rng.uniform(-7, 7, count))
        z[side == 2] = 0
        noisy = np.stack([x, y, z], axis=1) + rng.normal(0, 0.003, (count, 3))
        yield noisy + ORIGIN, np.where(window, 60, 180).astype(np.uint8)


def write_laz(path: Path, points: int) -> None:
    """Write the street as LAZ, in millimetres."""
    import laspy

    header = laspy.LasHeader(point_format=3, version="1.4")
    header.offsets, header.scales = ORIGIN, np.full(3, 1e-3)
    with laspy.open(path, mode="w", header=header) as file:
        for places, grey in street(points):
            record = laspy.ScaleAwarePointRecord.zeros(len(places), header=header)
            record.x, record.y, record.z = places.T
            record.red = record.green = record.blue = grey.astype(np.uint16) << 8
            file.write_points(record)


def write_ply(path: Path, points: int) -> None:
    """Write the street as binary PLY of doubles and colours."""
    columns = [
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {c}" for c in ("red", "green", "blue")),
    ]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {points}", *columns, "end_header\n"]
    with path.open("wb") as file:
        file.write("\n".join(head).encode())
        for places, grey in street(points):
            rows = np.empty(len(places), [("place", "<f8", 3), ("colour", "u1", 3)])
            rows["place"], rows["colour"] = places, grey[:, None]
            file.write(rows.tobytes())


def measured(code: str, path: Path) -> tuple[str, list[float]]:
    """What code prints in a fresh process, and its seconds, seconds of CPU, and peak memory of it and its child."""
    command = [sys.executable, "-c", MEASURED.format(code=code), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *said, numbers = done.stdout.strip().splitlines()
    return " ".join(said), [float(number) for number in numbers.split()]


def main(benchmark: Benchmark) -> None:
    """Write, read, print."""
    console, points = Console(soft_wrap=True), round(1e6 * benchmark.points)
    with tempfile.TemporaryDirectory(dir=benchmark.folder) as folder:
        for suffix in benchmark.formats:
            path, start = Path(folder) / f"street.{suffix}", time.perf_counter()
            {"laz": write_laz, "ply": write_ply}[suffix](path, points)
            console.print(f"{path.name} written in {time.perf_counter() - start:.0f} s", highlight=False)
            size = path.stat().st_size / 1e9
            for name, code in (("bare", READ[suffix]), ("merged", READ["merged"])):
                said, (seconds, cpu, memory, child) = measured(code, path)
                speed = f"{seconds:.0f} s, {cpu:.0f} s of CPU, {points / seconds / 1e6:.2f} million points/s"
                peaks = f"{memory:.2f} GB of memory and {child:.2f} of its child"
                console.print(f"{suffix}, {size:.2f} GB, {name}: {speed}, {peaks}. {said}", highlight=False)
            path.unlink()


if __name__ == "__main__":
    main(tyro.cli(Benchmark, description=__doc__))

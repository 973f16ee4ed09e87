"""A Ray cluster as a user names it, and what a run takes of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Optional

from shellgs_method.bounds import Length, Weight, check_bounds
from shellgs_method.errors import SceneError

GB = 10**9


@dataclass(frozen=True)
class Cluster:
    """A Ray cluster, and what each run takes of it; an autoscaling cluster starts the nodes that runs request."""

    address: Optional[str] = None
    """Address of a running Ray cluster, or auto. If not set: one is started on this machine."""
    gpus_per_run: Optional[Weight] = None
    """GPUs for each run on a Ray cluster. If not set: 1 if a node has one now, else 0."""
    cpus_per_run: Length = 1.0
    """CPU cores for each run on a Ray cluster."""
    memory_per_run: Optional[Weight] = None
    """Memory in GB for each run on a Ray cluster. If not set: memory is not considered."""

    def __post_init__(self) -> None:
        """Refuse what Ray cannot give.

        Raises:
            SceneError: a number is negative, or of more than one GPU not whole.
        """
        check_bounds(Cluster, vars(self))
        gpus = self.gpus_per_run or 0.0
        if gpus > 1 and gpus % 1:
            raise SceneError(f"--gpus-per-run cannot be {gpus:g}: above 1 it must be whole")

    def per_run(self, nodes: Sequence[Mapping[str, float]]) -> Share:
        """What a run takes, where these nodes have the resources that Ray names."""
        gpus = self.gpus_per_run
        if gpus is None:
            gpus = float(any(node.get("GPU", 0) >= 1 for node in nodes))
        return Share(self.cpus_per_run, gpus, GB * (self.memory_per_run or 0.0))


@dataclass(frozen=True)
class Share:
    """What a run takes of a node: CPU cores, GPUs, and bytes of memory."""

    cpus: float
    gpus: float
    memory: float

    @property
    def options(self) -> dict[str, Any]:
        """The options of a Ray task."""
        memory = {"memory": int(self.memory)} if self.memory else {}
        return {"num_cpus": self.cpus, "num_gpus": self.gpus, **memory}

    def room(self, nodes: Sequence[Mapping[str, float]]) -> int:
        """Number of runs that nodes have room for at once."""
        taken = {"CPU": self.cpus, "GPU": self.gpus, "memory": self.memory}
        return sum(min(int(node.get(name, 0) / amount) for name, amount in taken.items() if amount) for node in nodes)

    def lacking(self, nodes: Sequence[Mapping[str, float]]) -> str:
        """What a run takes, in words, if no node has it; else nothing."""
        if self.room(nodes):
            return ""
        memory = f", {self.memory / GB:g} GB of memory" if self.memory else ""
        return f"{self.gpus:g} GPUs, {self.cpus:g} CPU cores{memory}"

"""What a run takes of a cluster: one GPU where there are any, and what is asked for where none is yet."""

from __future__ import annotations

import pytest

from shellgs_method.errors import SceneError
from shellgs_method.launch.resources import GB, Cluster

CPUS = {"CPU": 16.0, "memory": 60.0 * GB}
GPUS = CPUS | {"GPU": 2.0}


@pytest.mark.parametrize(
    ("cluster", "nodes", "room"),
    [
        (Cluster(), [CPUS], 16),
        (Cluster(), [CPUS, GPUS], 2),
        (Cluster(gpus_per_run=0), [CPUS, GPUS], 32),
        (Cluster(gpus_per_run=0.5), [GPUS], 4),
        (Cluster(cpus_per_run=6), [CPUS, CPUS], 4),
        (Cluster(memory_per_run=25), [GPUS, GPUS], 4),
        (Cluster(memory_per_run=50), [GPUS, GPUS], 2),
    ],
)
def test_a_run_takes_one_node_s_resources(cluster, nodes, room):
    takes = cluster.per_run(nodes)
    assert takes.room(nodes) == room
    assert not takes.lacking(nodes)


def test_what_no_node_has_yet_is_asked_for_and_told():
    takes = Cluster(gpus_per_run=1, memory_per_run=100).per_run([CPUS, CPUS])
    assert takes.options == {"num_cpus": 1, "num_gpus": 1, "memory": 100 * GB}
    assert takes.lacking([CPUS, CPUS]) == "1 GPUs, 1 CPU cores, 100 GB of memory"


@pytest.mark.parametrize("numbers", [{"gpus_per_run": -1}, {"gpus_per_run": 1.5}, {"cpus_per_run": -2}])
def test_what_ray_cannot_give_is_refused(numbers):
    with pytest.raises(SceneError, match=f"--{next(iter(numbers)).replace(chr(95), chr(45))} cannot be"):
        Cluster(**numbers)

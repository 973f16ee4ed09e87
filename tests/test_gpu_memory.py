"""Training views on a GPU: which are kept there, and that they are what they were."""

from __future__ import annotations

import pytest
import torch
from training_runs import data_of, trainer_of

import shellgs_method.datamanager


@pytest.fixture
def data(pristine_scene, tmp_path, monkeypatch):
    """A data manager whose GPU has room for three of its eight views; copies to it stay on the CPU."""
    data = data_of(trainer_of(pristine_scene, tmp_path, "shellgs"))
    assert len(data.cached_train) == 8
    monkeypatch.setattr(data, "device", "cuda")
    monkeypatch.setattr(shellgs_method.datamanager, "_moved", lambda value, _: value)
    monkeypatch.setattr(shellgs_method.datamanager, "_pinned", lambda value: value)
    of_a_view = data.train_dataset.nbytes("uint8") / len(data.train_dataset)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (3 * 3.5 * of_a_view, 0))
    return data


def test_views_stay_on_the_gpu_as_far_as_its_memory_allows(data):
    for index in range(8):
        data._on_gpu(data.cached_train[index])
    assert data._kept_on_gpu == {0, 1, 2}
    assert all(data._on_gpu(data.cached_train[index]) is data.cached_train[index] for index in range(3))
    assert data._on_gpu(data.cached_train[5]) is not data.cached_train[5]


def test_a_view_on_the_gpu_has_its_photograph_and_maps(data, monkeypatch):
    expected = [data._with_maps(view) for view in data.cached_train]
    for held in (True, False):  # the maps in memory, or read from disk
        monkeypatch.setattr(data.train_dataset, "held", held)
        for _ in range(2):
            for index, view in enumerate(expected):
                actual = data._on_gpu(data.cached_train[index])
                assert actual.keys() == view.keys()
                assert all(torch.equal(actual[key], view[key]) for key in view if key != "image_idx")

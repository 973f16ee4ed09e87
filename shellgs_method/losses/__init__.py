"""Terms of the training loss: differentiable functions of [H, W, C] maps in the camera frame.

L = R + α(t) D + β N + γ C, with R photometric, D depth, N normal and C normal smoothness; the others are off in the
paper's setting. Masks are true where a pixel counts; an empty mask gives a differentiable zero.

A class ``…Loss`` is the loss of many renders of one view: what depends on the view alone is computed once.
All run as loops in C++ on a CPU, as one kernel each on CUDA, see :mod:`shellgs_method.machine.elementwise`.
"""

from shellgs_method.losses.depth import NccLoss, vid2sim_ncc_loss
from shellgs_method.losses.empty_space import EmptySpaceLoss
from shellgs_method.losses.normal import NormalLoss
from shellgs_method.losses.photometric import PhotometricLoss
from shellgs_method.losses.schedules import PAPER_ITERATIONS, ExponentialDecay
from shellgs_method.losses.self_consistency import flattening_loss, normal_consistency_loss
from shellgs_method.losses.smoothness import SmoothnessLoss

__all__ = [
    "PAPER_ITERATIONS",
    "EmptySpaceLoss",
    "ExponentialDecay",
    "NccLoss",
    "NormalLoss",
    "PhotometricLoss",
    "SmoothnessLoss",
    "flattening_loss",
    "normal_consistency_loss",
    "vid2sim_ncc_loss",
]

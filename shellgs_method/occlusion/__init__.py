"""Where photographs contradict the shell."""

from shellgs_method.occlusion.check import check_views, compared_others
from shellgs_method.occlusion.displaced import DISPLACED, Displaced
from shellgs_method.occlusion.verdicts import CONTRADICTED_PLACES, MANY, UNCLEAR, shell_verdicts

__all__ = [
    "CONTRADICTED_PLACES",
    "DISPLACED",
    "MANY",
    "UNCLEAR",
    "Displaced",
    "check_views",
    "compared_others",
    "shell_verdicts",
]

"""What photographs say against the shell."""

from shellgs_method.occlusion.check import check_views, compared_others
from shellgs_method.occlusion.displaced import read_displaced
from shellgs_method.occlusion.verdicts import CONTRADICTED_PLACES, MANY, UNCLEAR, shell_verdicts

__all__ = [
    "CONTRADICTED_PLACES",
    "MANY",
    "UNCLEAR",
    "check_views",
    "compared_others",
    "read_displaced",
    "shell_verdicts",
]

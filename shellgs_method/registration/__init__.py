"""The pose of the shell in the scene: found, refined, validated and reported."""

from shellgs_method.registration.validation import validate

__all__ = [
    "validate",
]

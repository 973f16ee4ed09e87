"""The pose of the shell in the scene: found, refined, validated and reported."""

"""Where the shell stands in the scene."""

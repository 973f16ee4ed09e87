"""Print the lowest versions that pyproject.toml allows of the packages of extras: python lowest.py mono usd …"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import tomllib

extras = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]["optional-dependencies"]
lines = [line for extra in sys.argv[1:] for line in extras[extra]]
print(*(re.sub(r">=([^,;]+).*", r"==\1", line) for line in lines))

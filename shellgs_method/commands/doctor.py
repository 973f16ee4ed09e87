"""`shellgs doctor`: check this machine."""

from __future__ import annotations

import sys

from rich.table import Table
from rich.text import Text

from shellgs_method.commands.common import console


def doctor() -> None:
    """Check what this machine can run, and name the remedy for what it cannot."""
    from shellgs_method.machine.doctor import examine

    table = Table(title="shellgs doctor")
    for heading in ("", "part", "finding"):
        table.add_column(heading)
    findings = list(examine())
    for finding in findings:
        mark = ("✓", "green") if finding.works else ("✗", "red") if finding.needed else ("–", "yellow")
        table.add_row(Text(*mark), finding.subject, finding.detail)
    console.print(table)
    if missing := [f"{found.subject}: {found.detail}" for found in findings if found.needed and not found.works]:
        sys.exit(f"shellgs: nothing runs here until this is fixed: {'; '.join(missing)}")

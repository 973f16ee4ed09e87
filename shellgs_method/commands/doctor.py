"""`shellgs doctor`: check this machine."""

from __future__ import annotations

import sys

from rich.text import Text

from shellgs_method.commands.common import console, table


def doctor() -> None:
    """Check what this machine can run, and name what to install for the rest."""
    from shellgs_method.machine.doctor import examine

    parts = table("", "part", "finding", title="shellgs doctor")
    findings = list(examine())
    for finding in findings:
        mark = ("✓", "green") if finding.works else ("✗", "red") if finding.needed else ("–", "yellow")
        parts.add_row(Text(*mark), finding.subject, finding.detail)
    console.print(parts)
    if missing := [f"{found.subject}: {found.detail}" for found in findings if found.needed and not found.works]:
        sys.exit(f"shellgs: nothing runs here until this is fixed: {'; '.join(missing)}")

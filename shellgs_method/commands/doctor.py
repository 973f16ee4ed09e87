"""`shellgs doctor`: what this machine can run."""

from __future__ import annotations

import sys

from rich.table import Table

from shellgs_method.commands.common import console


def doctor(install_libraries: bool = False) -> None:
    """What this machine can run, each with its remedy.

    Args:
        install_libraries: Install the system libraries that are missing, where apt-get is there and may be used.
    """
    from shellgs_method.environment import examine, install_system_libraries

    if install_libraries:
        install_system_libraries()
    table = Table(title="shellgs doctor")
    for heading in ("", "part", "finding"):
        table.add_column(heading)
    findings = list(examine())
    for finding in findings:
        mark = "[green]✓" if finding.works else "[red]✗" if finding.needed else "[yellow]–"
        table.add_row(mark, finding.subject, finding.detail)
    console.print(table)
    if missing := [f"{found.subject}: {found.detail}" for found in findings if found.needed and not found.works]:
        sys.exit(f"shellgs: nothing runs here before this is mended: {'; '.join(missing)}")

"""The documentation pages: valid links, and messages quoted as the program prints them."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "benchmarks/README.md", *sorted(ROOT.glob("docs/*.md"))]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and MyST name them."""
    included = [page.parent / name for name in re.findall(r"{include} (\S+)", page.read_text())]
    headings = [re.findall(r"^#+ (.*)", file.read_text(), re.MULTILINE) for file in (page, *included)]
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for each in headings for heading in each}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_are_valid(page):
    text = re.sub(r"^```.*?^```|`[^`]*`", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        if not target.is_file() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


def test_every_page_is_in_the_table_of_contents():
    listed = re.findall(r"^([\w-]+)$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    assert sorted(listed) == sorted(page.stem for page in ROOT.glob("docs/*.md") if page.stem != "index")


def test_troubleshooting_quotes_the_programs_messages():
    sources = [*ROOT.glob("shellgs_method/**/*.py"), *ROOT.glob("dataparsers/*.py")]
    messages = "\n".join(text for source in sources for text in strings(ast.parse(source.read_text())))
    rows = re.findall(r"^\| (.*?) \|", (ROOT / "docs/troubleshooting.md").read_text(), re.MULTILINE)
    quoted = [part.strip(" :,.") for row in rows for part in re.split(r"…|;", row.replace("`", ""))]
    quoted = [part for part in quoted if len(part) > 9]
    assert len(quoted) > 100
    assert [part for part in quoted if part not in messages.replace("`", "")] == []


def strings(tree: ast.AST) -> list[str]:
    """String literals of a program; each value formatted into an f-string becomes an ellipsis."""
    parts = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            parts.append(node.value)
        elif isinstance(node, ast.JoinedStr):
            parts.append("".join(str(v.value) if isinstance(v, ast.Constant) else "…" for v in node.values))
    return parts

"""Every link in README.md and docs/ leads somewhere, and every file that they name is there."""

import re
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
CODE = re.compile(r"^(```|~~~).*?^\1\s*$", re.M | re.S)
LINK = re.compile(r"!?\[(?:[^\[\]]|\[[^\]]*\])*\]\(\s*<?([^)>\s]+)>?(?:\s+\"[^\"]*\")?\s*\)")
NAMED = re.compile(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|md|toml|proto|service|sh|eds|dbc))`")


def prose(page):
    return CODE.sub("", page.read_text(encoding="utf-8"))


def anchors(page):
    """Names of a page's headings as they stand behind # in a link."""
    titles = re.findall(r"^#+\s+(.*?)\s*#*$", prose(page), re.M)
    plain = (re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles)
    return set(plain)


def links(page):
    return LINK.findall(prose(page))


def leads_somewhere(page, target, root):
    path, _, anchor = unquote(target).partition("#")
    aim = (page.parent / path).resolve() if path else page
    if not aim.exists() or not aim.is_relative_to(root):
        return False
    return not anchor or aim.suffix != ".md" or anchor in anchors(aim)


def broken(page, root=ROOT):
    """Links of a page that lead to nothing within the root."""
    for target in links(page):
        if re.match(r"[a-z]+:", target):
            continue
        if not leads_somewhere(page, target, root):
            yield target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_page__links__all_lead_somewhere(page):
    assert list(broken(page)) == []


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name != "CHANGELOG.md"],  # which may name what has gone since
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_page__files_named_by_their_path__are_there(page):
    named = NAMED.findall(prose(page))
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_pages__paper_and_tuner__lead_to_the_tables():
    for name in ("paper.md", "tuner.md"):
        assert "compare/README.md" in links(ROOT / "docs" / name)


def test_broken__page_with_every_mistake__finds_each(tmp_path):
    page = ROOT / "README.md"
    assert "docs/paper.md" in links(page)
    wrong = tmp_path / "wrong.md"
    wrong.write_text("# One\n[a](none.md) [b](#two) ![c](x.png) [d](#one)\n```\n[e](no.md)\n```\n")
    assert list(broken(wrong, tmp_path)) == ["none.md", "#two", "x.png"]

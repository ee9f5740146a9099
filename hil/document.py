"""Small documents, written once as Markdown and once as one self-contained HTML file."""

import base64
import html
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Final

_PAGE: Final = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2733; margin: 2rem auto; max-width: 62rem;
       padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.9rem 0.2rem 0; text-align: left; border-bottom: 1px solid #e3e8ee; }
img { max-width: 100%; } figure { margin: 0 0 1.6rem; }
figcaption { color: #56657a; font-size: 0.9rem; }
.PASS { color: #1d7a34; } .FAIL { color: #b3261e; font-weight: 700; }
</style>
$body
</html>
""")


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading; level 1 is the title."""

    text: str
    level: int = 2

    def markdown(self) -> str:
        """Render for the Markdown file."""
        return f"{'#' * self.level} {self.text}"

    def html(self) -> str:
        """Render for the HTML file."""
        return f"<h{self.level}>{html.escape(self.text)}</h{self.level}>"


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text."""

    text: str

    def markdown(self) -> str:
        """Render for the Markdown file."""
        return self.text

    def html(self) -> str:
        """Render for the HTML file."""
        return f"<p>{html.escape(self.text)}</p>"


@dataclass(frozen=True, slots=True)
class Table:
    """A table; cells that say PASS or FAIL are coloured in HTML."""

    titles: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Render for the Markdown file."""
        lines = [self.titles, ["---"] * len(self.titles), *self.rows]
        return "\n".join(f"| {' | '.join(map(_escape_cell, line))} |" for line in lines)

    def html(self) -> str:
        """Render for the HTML file."""
        head = "".join(f"<th>{html.escape(title)}</th>" for title in self.titles)
        body = "\n".join(f"<tr>{''.join(map(_html_cell, row))}</tr>" for row in self.rows)
        return f"<table>\n<tr>{head}</tr>\n{body}\n</table>"


def _escape_cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _html_cell(text: str) -> str:
    mark = f' class="{text}"' if text in ("PASS", "FAIL") else ""
    return f"<td{mark}>{html.escape(text)}</td>"


@dataclass(frozen=True, slots=True)
class Image:
    """A PNG beside the Markdown file, inside the HTML file."""

    path: Path
    title: str
    caption: str = ""

    def markdown(self) -> str:
        """Render for the Markdown file."""
        caption = f"\n\n{self.caption}" if self.caption else ""
        return f"![{self.title}]({self.path.name}){caption}"

    def html(self) -> str:
        """Render for the HTML file."""
        data = base64.b64encode(self.path.read_bytes()).decode()
        alt, caption = html.escape(self.title), html.escape(self.caption)
        source = f"data:image/png;base64,{data}"
        return (
            f'<figure><img alt="{alt}" src="{source}"><figcaption>{caption}</figcaption></figure>'
        )


Block = Heading | Paragraph | Table | Image


def write_document(blocks: Iterable[Block], folder: Path, name: str) -> Path:
    """Write `name`.md and `name`.html and return the path of the latter.

    Args:
        blocks: The first is the title.
        folder: Where images already are.
        name: Without suffix.

    Raises:
        OSError: If a file cannot be written.
    """
    blocks = list(blocks)
    markdown = "\n\n".join(block.markdown() for block in blocks)
    (folder / f"{name}.md").write_text(f"{markdown}\n", encoding="utf-8")
    title = blocks[0].text if isinstance(blocks[0], Heading) else name
    body = "\n".join(block.html() for block in blocks)
    page = folder / f"{name}.html"
    page.write_text(_PAGE.substitute(title=html.escape(title), body=body), encoding="utf-8")
    return page

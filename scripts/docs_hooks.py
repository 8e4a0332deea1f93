"""What mkdocs asks while it builds the site: pages of docs/ link to files beside docs/, which the site has too."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File, Files

ROOT: Final = Path(__file__).resolve().parent.parent
BESIDE: Final = {"README.md": "repository.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
_LINK: Final = re.compile(r"\]\((?!https?:|#)([^)\s]+)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the files beside docs/, with links as they are seen from inside of it."""
    for name, page in BESIDE.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=_LINK.sub(_from_the_root, text)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links to files beside docs/ lead to their pages."""
    up = "../" * page.file.src_uri.count("/")
    for name, target in BESIDE.items():
        markdown = markdown.replace(f"]({up}../{name}", f"]({up}{target}")
    return markdown


def _from_the_root(match: re.Match[str]) -> str:
    """Turn a link of a file beside docs/ into one of a page; what the site does not have stays readable text."""
    target, _, anchor = match[1].partition("#")
    if target.startswith("docs/"):
        found = target.removeprefix("docs/")
    elif target in BESIDE:
        found = BESIDE[target]
    else:
        return "]"  # a reference without a target: Markdown shows its text
    return f"]({found}{'#' + anchor if anchor else ''})"

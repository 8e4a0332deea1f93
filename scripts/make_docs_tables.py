"""Write docs/tables.md and docs/config.md from the code; with --check, fail when they are not what would be written."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from audit.config import AuditConfig
from audit.table import TABLES

DOCS = Path(__file__).resolve().parents[1] / "docs"
TABLES_INTRODUCTION = """# Tables

Made from `audit/table.py` by `scripts/make_docs_tables.py`; do not edit.

A run folder holds one Parquet file per model in `RUN/images` (one row per registered image) and in `RUN/models` (one
row per model). `pandas.read_parquet(RUN + "/images")` reads all of them. A value that was not computed is null, never a
number that stands for it. The unit and the meaning of a column are also in the files, as field metadata.
"""
HEADERS = {
    "images": "One row per registered image. METHOD.md names the quantities.",
    "models": "One row per model.",
}
CONFIG_INTRODUCTION = """# Settings

Made from `audit/config.py` by `scripts/make_docs_tables.py`; do not edit.

`sfm-audit run PATH... -o RUN --config FILE.toml` reads settings by name from a TOML file, such as

```toml
noise = "constant"
alpha = 0.01
```

What the file leaves out keeps its default; options of the command line come before the file. An unknown name or a value
of the wrong kind is refused. A run folder holds the tables of one config: another one needs another folder.
"""


def table_page() -> str:
    """Return docs/tables.md."""
    parts = [TABLES_INTRODUCTION]
    for name, columns in TABLES.items():
        rows = [f"| `{c.name}` | {_arrow(str(c.type))} | {c.unit} | {_cell(c.meaning)} |" for c in columns]
        table = "\n".join(["| column | type | unit | meaning |", "|---|---|---|---|", *rows])
        parts.append(f"## `{name}`\n\n{HEADERS[name]}\n\n{table}\n")
    return "\n".join(parts)


def config_page() -> str:
    """Return docs/config.md."""
    rows = [
        f"| `{name}` | `{field.default}` | {_cell(field.description or '')} |"
        for name, field in AuditConfig.model_fields.items()
    ]
    return "\n".join([CONFIG_INTRODUCTION, "| setting | default | meaning |", "|---|---|---|", *rows, ""])


PAGES = {"tables.md": table_page, "config.md": config_page}


def main() -> int:
    """Write or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing, fail when a page is stale")
    check = parser.parse_args().check
    stale = 0
    for name, render in PAGES.items():
        path, page = DOCS / name, render()
        if not check:
            DOCS.mkdir(exist_ok=True)
            path.write_text(page, encoding="utf-8")
        elif not path.exists() or path.read_text(encoding="utf-8") != page:
            print(f"{path}: not what the code says; run scripts/make_docs_tables.py", file=sys.stderr)
            stale = 1
    return stale


def _arrow(kind: str) -> str:
    return kind.replace("element: ", "").replace("double", "float64").replace("string", "text")


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


if __name__ == "__main__":
    sys.exit(main())

"""The tutorials of docs/tutorials, walked from their text: the commands that they print are the commands that run."""

import importlib.util

import pytest

from scripts import run_tutorials

LEAST_FOUND = 0.6  # of the lines of a page; words of other versions of the dependencies differ

needs_extras = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("jinja2", "matplotlib", "cv2", "poselib")),
    reason="the extras report and calibrate are not installed",
)


@needs_extras
@pytest.mark.parametrize("pages", run_tutorials.WALKS, ids=lambda pages: pages[0])
def test_a_tutorial_can_be_followed(pages, tmp_path):
    steps = run_tutorials.walk_together(pages, tmp_path)
    assert {step.page for step in steps} == set(pages)
    assert [(step.command, step.printed) for step in steps if step.exit_code != 0] == []
    for page in pages:
        shown = [step.share_found for step in steps if step.page == page]
        assert sum(shown) >= LEAST_FOUND * len(shown), page


def test_every_tutorial_is_walked():
    pages = {page for pages in run_tutorials.WALKS for page in pages}
    assert pages == {path.name for path in run_tutorials.FOLDER.glob("*.md")}


PAGE = """Text.

```python title="a.py"
print("one 1")
```

```console
$ python a.py
one 2
$ pwd; exit 3
```
"""


def test_a_walk_runs_what_is_printed_and_writes_what_it_prints(tmp_path):
    text, steps = run_tutorials.walk("p.md", PAGE, tmp_path)
    assert text == PAGE.replace("one 2", "one 1").replace("exit 3\n", f"exit 3\n{tmp_path}\n")
    assert [(step.command, step.exit_code, step.share_found, step.is_as_shown) for step in steps] == [
        ("python a.py", 0, 1.0, True),
        ("pwd; exit 3", 3, 0.0, False),
    ]
    again, steps = run_tutorials.walk("p.md", text, tmp_path)
    assert again == text
    assert all(step.is_as_shown for step in steps)

"""``sfm-audit report``: one HTML file about a run, for people."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from sfm_audit.audit.cli.again import Again, with_again
from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.extras import extra
from sfm_audit.audit.cli.runs import open_run
from sfm_audit.audit.cli.terminal import is_stdout, print_page, write_stdout
from sfm_audit.reports.errors import OutputError, RunFolderError
from sfm_audit.reports.run_folder.new_files import OutputExistsError, check_free, write_file
from sfm_audit.reports.text.wording import counted, plain


@click.command("report", short_help="Write one HTML page about a run, to look at and to send.")
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", type=click.Path(path_type=Path), default=Path("report.html"), show_default=True, help="- is stdout."
)
@click.option("--images", "photos", metavar="DIR", type=click.Path(path_type=Path), help="Folder of the photos.")
@click.option(
    "--worst", type=click.IntRange(0, 100), default=12, show_default=True, help="How many images get pictures."
)
@click.option(
    "--model",
    "models",
    metavar="LOCATION",
    multiple=True,
    help="Models of RUN in this object store may be read; RUN alone opens none. Repeatable.",
)
@with_again
@click.option("--force", is_flag=True, help="Replace the page if it is there.")
@click.option("--quiet", is_flag=True, help="Print nothing but errors.")
def command(
    *,
    run: Path,
    out: Path,
    photos: Path | None,
    worst: int,
    models: tuple[str, ...],
    force: bool,
    quiet: bool,
    **again: Any,
) -> ExitCode:
    """Write one HTML page about the run folder RUN: it needs no network and no other file.

    Pictures of the worst images are drawn from RUN/observations (run --observations), or from the models where they
    still lie on this machine as the run read them. With --images, photos are found as DIR/<name> or
    DIR/<scene>/images/<name>.

    Exit codes: 0 fine; 2 wrong usage, or the page exists; 3 RUN is no run folder or cannot be read; 4 the page could
    not be written.
    """
    try:
        if not is_stdout(out):
            check_free(out, force=force)
        if photos is not None and not photos.is_dir():
            raise KnownError(f"{photos}: is no folder; name the folder of the photos", ExitCode.USAGE)
        reader = Again.of(**again).read(open_run(run, quiet=quiet))
        with extra("report"):
            from sfm_audit.audit.cli.report_page import make_page  # noqa: PLC0415 - needs the extra
        page = make_page(reader, photos, worst, models, silent=quiet or not sys.stderr.isatty())
        content = page.text.encode()
        if is_stdout(out):
            write_stdout(content)
        else:
            write_file(out, content)
    except OutputExistsError as error:
        raise KnownError(str(error), ExitCode.USAGE) from error
    except RunFolderError as error:
        raise KnownError(str(error), ExitCode.UNREADABLE_INPUT) from error
    except OutputError as error:
        raise KnownError(str(error), ExitCode.OUTPUT) from error
    if page.num_wanted and not page.num_photos:
        complain(
            f"{photos}: holds none of the {counted(page.num_wanted, 'photo')} of the page; expected DIR/<name> or "
            f"DIR/<scene>/images/<name>, such as {photos}/{page.example}"
        )
    if not quiet:
        what = f"{counted(page.num_images, 'image')}, pictures of {page.num_drawn}, {len(content) / 1e6:.1f} MB"
        print_page(f"{'stdout' if is_stdout(out) else plain(str(out))}: {what}", to_stderr=is_stdout(out))
    return ExitCode.OK

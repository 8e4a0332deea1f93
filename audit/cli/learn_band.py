"""``sfm-audit learn-band``: learn how much reconstructions of the same photos differ by themselves."""

from __future__ import annotations

from pathlib import Path

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError, complain
from sfm_audit.audit.cli.poses import aligned
from sfm_audit.audit.cli.runs import ComparedRun, read_run, refuse_different_settings, without_poses, write_file
from sfm_audit.audit.cli.terminal import is_stdout, print_page
from sfm_audit.reports.compare.learning import gate_toml, learn_bands, says_nothing

_RECOMMENDED = 3
_LEAST_COMMON = 0.5  # of the images of two runs: reconstructions of the same photos share nearly all


@click.command("learn-band", short_help="Learn what repeated reconstructions differ by, as a gate file.")
@click.argument("runs", metavar="RUN1 RUN2...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--out", metavar="GATE.toml", type=click.Path(path_type=Path), help="Write here.  [default: print]")
@click.option("--force", is_flag=True, help="Write over an existing file.")
def command(*, runs: tuple[Path, ...], out: Path | None, force: bool) -> ExitCode:
    """Write a gate file whose bands leave room for what COLMAP does differently each time.

    RUN1 RUN2... are run folders of reconstructions of the same photos, made with different seeds or simply again; two
    are needed, three recommended, five better. docs/nightly.md says by which rule the bands follow from them.

    Exit codes: 0 fine; 2 wrong usage, or runs of different settings; 3 one of them is no finished run or has inputs
    that could not be read; 4 GATE.toml could not be written.
    """
    if len(runs) < 2:
        raise click.UsageError("A band takes two runs or more.")
    if out is not None and not is_stdout(out) and out.exists() and not force:
        raise KnownError(f"{out}: exists already; choose another -o, or --force to write over it", ExitCode.USAGE)
    read = [read_run(folder) for folder in runs]
    refuse_different_settings(read)
    _refuse_unusable(read)
    learnt = learn_bands([each.snapshot for each in read], aligned)
    content = gate_toml(learnt, [str(folder) for folder in runs])
    for warning in [*without_poses(read), *_not_the_same_photos(read), *says_nothing(learnt)]:
        _warn(warning)
    if len(runs) < _RECOMMENDED:
        _warn(f"two runs say little about how much a third differs; {_RECOMMENDED} or more are recommended")
    everywhere = set.intersection(*(each.snapshot.scenes for each in read))
    for dataset, scene in sorted(set.union(*(each.snapshot.scenes for each in read)) - everywhere):
        _warn(f"{dataset}/{scene} is not in every run: the band allows that it is lost")
    if out is None:
        print_page(content.rstrip("\n"))
    else:
        write_file(out, content.encode())
    return ExitCode.OK


def _refuse_unusable(runs: list[ComparedRun]) -> None:
    """A run that lacks what could not be read would teach that losing it is normal."""
    for run in runs:
        missing = [*run.unread, *run.stopped]
        if missing:
            problem = f"{run.folder}: has inputs that could not be read or audited ({missing[0][0]}); run again"
            raise KnownError(problem, ExitCode.UNREADABLE_INPUT)
    first = runs[0]
    for other in runs[1:]:
        if not first.snapshot.images.keys() & other.snapshot.images.keys():
            problem = f"{other.folder}: has no image of {first.folder}; audit folders of the same name"
            raise KnownError(problem, ExitCode.USAGE)


def _not_the_same_photos(runs: list[ComparedRun]) -> list[str]:
    """Return a warning per run that shares few images with the first."""
    first = runs[0]
    warnings = []
    for other in runs[1:]:
        mine, theirs = first.snapshot.images.keys(), other.snapshot.images.keys()
        common, together = len(mine & theirs), len(mine | theirs)
        if common < _LEAST_COMMON * together:
            warnings.append(
                f"{other.folder} and {first.folder} share {common} of their {together} images: are they "
                "reconstructions of the same photos? A band learnt from others allows anything"
            )
    return warnings


def _warn(text: str) -> None:
    complain(text)

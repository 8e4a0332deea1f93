"""``sfm-audit explain-code``: what a reason code or a finding means, and what to do about it."""

from __future__ import annotations

import click

from sfm_audit.audit.cli.errors import ExitCode, KnownError
from sfm_audit.audit.cli.suggestions import did_you_mean
from sfm_audit.audit.cli.terminal import print_page, terminal_page
from sfm_audit.audit.table.guidance import SECTIONS, sections_of
from sfm_audit.reports.text.codes import render_sections
from sfm_audit.reports.text.wording import paragraph, plain


@click.command("explain-code", short_help="Say what a reason code or finding means, and what to do.")
@click.argument("code", metavar="[CODE]", required=False)
def command(*, code: str | None) -> ExitCode:
    """Say what CODE means, a reason of an image or a finding of a model, and what to do about it.

    Usual causes, what to do, what not to conclude. Without CODE, list all codes with their meanings. docs/codes.md
    holds the same.

    Exit codes: 0 fine; 2 there is no such code.
    """
    page = terminal_page()
    if code is None:
        print_page("\n".join(paragraph(f"{each.code}: {each.meaning}", page.width, "  ") for each in SECTIONS))
        return ExitCode.OK
    found = sections_of(code)
    if not found:
        hint = did_you_mean(code, [each.code for each in SECTIONS]) or "; without a code, explain-code lists all"
        raise KnownError(f"{plain(code)}: no such reason or finding{hint}", ExitCode.USAGE)
    print_page(render_sections(found, page.width).rstrip("\n"))
    return ExitCode.OK

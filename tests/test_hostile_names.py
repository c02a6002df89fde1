"""Claim: a name from data is shown as it is, and is never markup, a path or a command."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from tests.endurance import tiny_case

from pse_analysis import recording
from pse_analysis.errors import TableError
from pse_analysis.estimation import Method
from pse_analysis.pipeline import account
from pse_analysis.pipeline.summary import markdown, text
from pse_analysis.recording import Take
from pse_analysis.recording.marks import markdown_table
from pse_analysis.scoring import score
from pse_analysis.telemetry import ingest, read_raw, write_raw
from pse_analysis.validation import ValidateParams
from pse_analysis.vocabulary import markdown_text

NAMES = (
    "<script>alert(1)</script>",
    "=cmd|' /C calc'!A0",
    "| a | b |",
    "../../../etc/passwd",
    "![x](http://example.org/x.png)",
    "`rm -rf ~`; $(reboot)",
    "__init__*",
    "# heading",
    "a:b/c",
    "Übergabe Ω €",
)
METHOD = Method.of("<b>wls</b>|../../x", "wls")


def hostile() -> tiny_case.Run:
    """The tiny case with odd names of its channels, and of one method."""
    tags = dict(zip(tiny_case.channel_table()["channel"], NAMES, strict=True))
    channels = tiny_case.channel_table().assign(channel=list(tags.values()))
    frame = tiny_case.telemetry().assign(channel=lambda f: f["channel"].map(tags))
    return tiny_case.estimate_raw(ingest(frame, channels, tiny_case.network()), (METHOD,))


@pytest.mark.parametrize("name", NAMES)
def test_markdown_shows_a_name_as_it_is(name: str) -> None:
    shown = markdown_text(name)
    assert "<" not in shown
    assert ">" not in shown
    assert "](" not in shown.replace("\\](", "")
    unescaped = shown.replace("&lt;", "<").replace("&gt;", ">").replace("&amp;", "&")
    for sign in "\\`*_[]|~$#":
        unescaped = unescaped.replace(f"\\{sign}", sign)
    assert unescaped == name


def test_words_of_this_project_stay_readable() -> None:
    for plain in ("kf_load", "vm_pu 0.97", "pmu:bus/6:vm_pu", "12.5", "-3.1 %", "–"):
        assert markdown_text(plain) == plain


def test_no_line_begins_a_heading_or_a_list() -> None:
    begun = {"# a": "\\# a", "- a": "\\- a", "+ a": "\\+ a", "12. a": "12\\. a", "==": "\\=="}
    assert {line: markdown_text(line) for line in begun} == begun


def test_a_cell_cannot_leave_its_table() -> None:
    table = markdown_table(("method", "n"), [("a|b\n| c", "1")])
    head, _ruler, *rows = table.splitlines()
    assert len(rows) == 1
    assert rows[0].replace("\\|", "").count("|") == head.count("|")


def test_all_stages_and_pages_bear_any_name(tmp_path: Path) -> None:
    run = hostile()
    done, raw = run.estimated[0], run.raw
    write_raw(tmp_path / "raw", raw)
    back = read_raw(tmp_path / "raw")
    assert set(back.channels["channel"]) == set(NAMES)

    truth = done.estimated.drop(columns=["method", "sigma"])
    scored = score(done.estimated, done.steps, run.validated, truth)
    told = account.of_run(
        *(raw.channels, run.validated, done.steps, done.residuals),
        study=tiny_case.STUDY,
        params=ValidateParams(),
        model=tiny_case.network(),
    )
    about = (*told.findings, *told.notices, f"worst of all is {NAMES[0]}")
    title = "<img src=x onerror=alert(1)> | [a](b)"
    page = markdown(title, scored, about)
    assert "<" not in page
    assert "](" not in page.replace("\\](", "")
    assert METHOD.name in text(title, scored, about)

    def take(stage: str) -> Take:
        return Take(tmp_path / f"{stage}.rrd", "odd", tiny_case.STUDY)

    recording.validated(take("validate"), run.validated, raw.channels)
    recording.aligned(take("align"), run.aligned, raw.channels, truth=None)
    recording.estimated(
        take("estimate"),
        *(done.estimated, done.steps, done.residuals),
        aligned=run.aligned,
        channels=raw.channels,
        network=tiny_case.network(),
        truth=truth,
    )
    recording.scored(
        take("score"), scored, done.estimated, truth, tiny_case.network(), summary_markdown=page
    )
    made = {path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*") if path.is_file()}
    assert made == {"raw", *(f"{s}.rrd" for s in ("validate", "align", "estimate", "score"))}


@pytest.mark.parametrize("source", ["../../x", "scada/../../x", "<script>", ""])
def test_a_source_is_one_of_four_and_no_path(source: str) -> None:
    channels = tiny_case.channel_table().assign(source=source)
    with pytest.raises(TableError, match="'source' of channel 'U1': expected one of 'scada'"):
        ingest(tiny_case.telemetry(), channels, tiny_case.network())


def test_notebooks_show_tables_with_their_names_escaped() -> None:
    frame = pd.DataFrame({"channel": NAMES})
    assert "<script>" not in frame._repr_html_()

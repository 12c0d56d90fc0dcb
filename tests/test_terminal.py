"""What people see: tables whole at every width, names taken literally, signs of life."""

import dataclasses
import io
import os
import re
import sys
from dataclasses import replace

import pytest

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.console import terminal
from mcx_jax.errors import printable
from mcx_jax.evaluation.table import (
    ONE_DIRECTION_NOTE,
    PAPER_NOTE,
    REPEAT_NOTE,
    percent,
    print_table,
)

SEAS = ("Wa", "Wb", "Wc", "Wd")
TASK = EnvConfig(), MotionConfig()


def row(who="ik", sea="Wd", delay="B4_4", scale=1.0, gain=0.0):
    """A result row; scale 100 gives the widest numbers that an arm in reach can have."""
    names = ("mean", "std", "top5", "top1", "max")
    numbers = dict(zip(names, (8.552, 4.66, 20.42, 23.86, 28.77), strict=True))
    errors = {name: scale * x for name, x in numbers.items()}
    better = dict.fromkeys(("all", "top5", "top1", "max"), gain)
    return {
        **{"who": who, "delay": delay, "sea": sea, "episodes": 50, "invalid_episodes": 3},
        **{"pos_mm": errors, "ang_mrad": errors, "improvement": {"pos": better, "ang": better}},
        "correction": {"max_cm": 2.44, "max_crad": 1.82, "rate_cm_s": 2.2, "rate_crad_s": 2.1},
        "torque_share": {"mean": 0.63, "at_limit": 0.058},
        "strain": {"steps": 47500, "out_of_reach": 0, "too_fast": 0},
    }


def shown(rows, columns, monkeypatch, env=TASK[0], motion=TASK[1]):
    monkeypatch.setenv("COLUMNS", str(columns))
    out = io.StringIO()
    print_table(rows, env, motion, out)
    return out.getvalue()


WIDEST = [row(who, sea, scale=100, gain=-1.23) for who in ("ik", "x" * 90) for sea in SEAS]


@pytest.mark.parametrize("columns", [40, 60, 80, 120, 150])
def test_no_number_is_cut_at_any_width(columns, monkeypatch):
    text = shown(WIDEST, columns, monkeypatch)
    assert "…" not in text and "..." not in text
    words = text.split()
    for number in ("855.200", "466.00", "2042.00", "2386.00", "2877.00", "~3.19", "0.97", "3/50"):
        assert number in words, number
    assert words.count("855.200") == 2 * len(WIDEST)
    assert text.count("-123 %") == 2 * len(WIDEST)
    if columns >= 80:
        assert max(len(line) for line in text.splitlines()) <= columns


def test_a_wide_terminal_has_one_table_of_errors_and_a_narrow_one_two(monkeypatch):
    for columns, count in ((80, 2), (150, 1)):
        text = shown([row(who, sea) for who in ("ik", "run") for sea in SEAS], columns, monkeypatch)
        assert len(re.findall("^ik +Wd ", text, re.MULTILINE)) == count


def test_a_name_that_does_not_fit_is_folded_and_whole(monkeypatch):
    name = "runs/" + "".join(f"part{i}-" for i in range(12))
    lines = shown([row(name)], 80, monkeypatch).splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("runs/"))
    pieces = [line.split(" ")[0] for line in lines[first:]]
    assert "".join(pieces).startswith(name)


MARKUP = "runs/[/b][red]x[/red]:boat:\\[bold]"


def test_names_are_taken_literally(monkeypatch):
    assert MARKUP in shown([row(MARKUP)], 150, monkeypatch)
    assert MARKUP in shown([row(sea=MARKUP, delay="E7")], 150, monkeypatch)
    assert f"delay {MARKUP}" in shown([row(delay=MARKUP)], 150, monkeypatch)


def test_names_that_cannot_be_printed_are_escaped(monkeypatch):
    bad = os.fsdecode(b"a\xff\x1b[31m\nb")
    assert printable(bad) == "a\\udcff\\x1b[31m\\nb"
    text = shown([row(bad)], 150, monkeypatch)
    assert printable(bad) in text and "\x1b" not in text
    text.encode("utf-8")


@pytest.mark.parametrize(
    ("share", "text"), [(-0.004, "0 %"), (0.0, "0 %"), (0.966, "97 %"), (-1.23, "-123 %")]
)
def test_nothing_gained_is_0_per_cent(share, text, monkeypatch):
    assert percent(share) == text
    assert f" {text} " in shown([row(gain=share)], 150, monkeypatch)


def test_the_papers_column_says_which_number_is_implied(monkeypatch):
    text = shown([row("ik"), row("policy")], 150, monkeypatch)
    # Table 3, B4_4, Wd: agents 0.97 mm and 0.97 mrad, the baseline that they imply 8.08 and 5.39.
    assert text.split().count("0.97") == 2
    assert "~8.08" in text and "~5.39" in text
    assert PAPER_NOTE[:60] in text


@pytest.mark.parametrize(
    ("env", "motion", "change"),
    [
        (EnvConfig(goal="circle"), TASK[1], {}),
        (*TASK, {"delay": "E3"}),
        (*TASK, {"sea": "3.0:11"}),
    ],
)
def test_without_a_paper_there_is_no_such_column(env, motion, change, monkeypatch):
    rows = [{**row(sea=sea), **change} for sea in SEAS]
    text = shown(rows, 150, monkeypatch, env, motion)
    assert "paper" not in text and "8.08" not in text
    if env == TASK[0]:  # one cell that it has brings the column back
        text = shown([*rows, row("run")], 150, monkeypatch, env, motion)
        assert text.count(" paper ") == 2 and "0.97" in text


def test_a_trained_policy_is_never_shown_without_where_it_holds(monkeypatch):
    words = ONE_DIRECTION_NOTE.split()
    assert "heading 170 deg" in ONE_DIRECTION_NOTE
    for who in ("shipped:robust", "runs/mine", "policy", "a.npz"):
        assert shown([row("ik"), row(who)], 80, monkeypatch).split()[-len(words) :] == words
    for who in ("ik", "fir", "preview", "extrapolate", "extrapolate-best"):
        assert "trained agents hold" not in shown([row(who)], 80, monkeypatch)


def test_maxima_are_said_to_repeat_only_roughly_where_servos_chatter(monkeypatch):
    said = REPEAT_NOTE[:40]
    assert said in shown([row()], 150, monkeypatch)
    assert said not in shown([row()], 150, monkeypatch, replace(TASK[0], integrator="quiet"))


def test_what_the_arm_cannot_do_is_counted_where_there_is_some(monkeypatch):
    calm, rough = row("ik", "Wa"), row("fir", "3.5:8")
    rough["strain"] = {"steps": 47500, "out_of_reach": 12, "too_fast": 340}
    said = " ".join(shown([calm, rough], 150, monkeypatch).split())
    assert (
        "fir, 3.5:8: the corrected goal out of the arm's reach in 12 of 47500 control steps; a "
        "joint asked to be faster than its servo takes in 340 of 47500 control steps"
    ) in said
    assert "ik, Wa:" not in said


def test_effort_is_each_number_of_the_sea_where_it_is_largest(monkeypatch):
    calm, rough = row("fir", "Wa"), row("fir", "Wd")
    calm["torque_share"] = {"mean": 0.91, "at_limit": 0.001}
    rough["correction"] = {"max_cm": 4.97, "max_crad": 0.1, "rate_cm_s": 9.0, "rate_crad_s": 0.1}
    text = shown([calm, rough], 150, monkeypatch)
    # Of the rough sea 49.7 mm and 90 mm/s, of the calm one the rest.
    assert re.search(r"^fir +49\.7 +18\.2 +90 +21 +91 +5\.8 *$", text, re.MULTILINE)


class Terminal(io.StringIO):
    """Says that it is one."""

    def isatty(self):
        return True


@pytest.fixture
def on_a_terminal(monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "80")


def test_a_step_has_its_name_and_its_seconds_on_a_terminal(on_a_terminal):
    out = Terminal()
    with terminal.working("first", out) as say:
        say("second [/b]")
    text = out.getvalue()
    assert "first" in text and "second [/b]" in text and "0:00:00" in text
    assert "\x1b[?25l" not in text, "the cursor is hidden: a killed process would leave it so"


def test_a_step_is_a_line_elsewhere(capsys):
    out = io.StringIO()
    with terminal.working("first", out) as say:
        say("second [/b]")
        assert out.getvalue() == "second [/b]\n"
    assert out.getvalue() == "second [/b]\n"
    with terminal.working("first") as say:
        say("third")
    assert capsys.readouterr().out == "third\n"


def test_a_command_without_an_output_goes_on(monkeypatch):
    """Its standard output was closed by whoever started it: Python has None there."""
    monkeypatch.setattr(sys, "stdout", None)
    with terminal.working("first") as say:
        say("second")
    print_table([row()], *TASK)


def test_width_is_what_was_asked_for_or_the_terminals_own(monkeypatch):
    monkeypatch.setenv("COLUMNS", "97")
    assert terminal.columns(io.StringIO()) == 97
    monkeypatch.setenv("COLUMNS", "0")
    assert terminal.columns(io.StringIO()) == terminal.PIPED_COLUMNS
    assert terminal.columns(None) > 0
    monkeypatch.setattr(os, "get_terminal_size", lambda fd: os.terminal_size((0, 0)))
    out = dataclasses.make_dataclass("Out", [])()
    out.fileno = lambda: 7
    assert terminal.columns(out) == terminal.SILENT_COLUMNS

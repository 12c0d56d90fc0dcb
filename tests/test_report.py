"""The report: one page that needs nothing else, with evaluate's numbers and every figure."""

import dataclasses
import json
import os
import re
import shutil
from html.parser import HTMLParser
from types import SimpleNamespace

import browser
import jax
import numpy as np
import pytest

from mcx_jax import extras, palette
from mcx_jax.arm.model import torque_limits_nm
from mcx_jax.config import command_line
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.config.training import TrainConfig
from mcx_jax.controllers.by_name import load_controller
from mcx_jax.errors import UserError
from mcx_jax.evaluate import errors_beside_ik, evaluate_beside_ik, evaluation_env
from mcx_jax.evaluation import episodes
from mcx_jax.evaluation.paper import table3
from mcx_jax.policy.file import Policy, PolicyMeta, save_policy
from mcx_jax.policy.networks import init_params
from mcx_jax.policy.normalise import init_stats
from mcx_jax.report import build, entries, figures, sections, style
from mcx_jax.report.__main__ import main
from mcx_jax.report.episode import Episode, lag_s, record
from mcx_jax.report.folder import check_out, write
from mcx_jax.report.noise import noise_sweep
from mcx_jax.report.page import page
from mcx_jax.report.sections import Section
from mcx_jax.report.spectra import motion_spectra
from mcx_jax.report.table import table

STEPS, EPISODES, SEED = 90, 2, 3
# implicitfast chatters less than Euler: rounding grows little.
TASK = EnvConfig(delay="E2", integrator="implicitfast", episode_steps=STEPS)
OPTIONS = ["--episodes", str(EPISODES), "--episode-steps", str(STEPS), "--seed", str(SEED)]


def make_run(path, env=TASK, seeds=2):
    """A run directory with an untrained policy and made-up metrics of two iterations."""
    path.mkdir(parents=True)
    text = command_line.config_to_json(
        TrainConfig(seeds=seeds, env=dataclasses.replace(env, episode_steps=1024))
    )
    meta = PolicyMeta(obs_size=38, action_size=6, hidden=8, config=text)
    policy = Policy(init_params(meta.net, jax.random.key(0), 38), init_stats((38,)), meta)
    save_policy(path / "policy.npz", policy)
    rows = [
        {"iteration": i, "steps": 1000 * i, "seed": k, "pos_error_mm": 8.0 / i + k}
        | {"ang_error_mrad": 4.0 / i + k, "wall_s": 60.0 * i}
        for i in (1, 2)
        for k in range(seeds)
    ]
    lines = [json.dumps(row) + "\n" for row in rows]
    (path / "metrics.jsonl").write_text("".join(lines) + '{"iteration": 3, "st')
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(report directory, run directory): a run beside ik in two kinds of section."""
    folder = tmp_path_factory.mktemp("report")
    run = make_run(folder / "runs" / "E2-tiny-s0")
    main([str(run), "--out", str(folder / "out"), "--sea", "Wb", "--noise-sweep", *OPTIONS])
    return folder / "out", run


class Page(HTMLParser):
    """What the tests look at."""

    VOID = ("meta", "img", "br", "hr", "link", "input")

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.open, self.tags, self.cells, self.text = [], [], [], ""
        self.feed(text)
        self.close()
        self.images = [a for tag, a in self.tags if tag == "svg"]
        self.ids = [a["id"] for _, a in self.tags if "id" in a]
        self.links = [a["href"] for _, a in self.tags if "href" in a]

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in ("td", "th"):
            self.cells.append("")
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag, (tag, self.getpos())

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.cells[-1] += data
        self.text += data


@pytest.fixture(scope="module")
def html(made):
    return (made[0] / "index.html").read_text(encoding="utf-8")


def test_page_parses_and_holds_every_figure(made, html):
    page = Page(html)
    assert page.open == []
    out = made[0]
    pngs = sorted(path.name for path in out.glob("*.png"))
    wanted = ("errors_dp", "errors_da", "follow_0", "follow_1", "episode_dp", "episode_da")
    wanted += ("correction_translation", "correction_rotation", "torque", "noise_dp", "noise_da")
    wanted += tuple(f"learning_{e}_{x}" for e in ("dp", "da") for x in ("steps", "wall"))
    wanted += tuple(f"spectrum_{c}" for c in ("surge", "sway", "heave", "roll", "pitch", "yaw"))
    assert pngs == sorted(f"{name}.png" for name in wanted)
    assert len(page.images) == len(pngs)
    assert all(image["role"] == "img" and image["aria-label"] for image in page.images)
    for said in ("python -m mcx_jax.report", "jax", "matplotlib", "CPU cores", '"delay": "E2"'):
        assert said in page.text, said


def test_contents_lead_to_every_section(html):
    page = Page(html)
    sections = [a["id"] for tag, a in page.tags if tag == "h2"]
    assert len(sections) == 8 and page.links[:8] == [f"#{name}" for name in sections]
    assert len(set(page.ids)) == len(page.ids)
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)


def test_nothing_comes_from_outside(html):
    page = Page(html)
    assert "://" not in html and "@import" not in html
    assert not {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object", "base"}
    assert not any("src" in a for _, a in page.tags)
    assert all(link.startswith("#") for link in page.links)
    assert html.count("url(") == html.count("url(#")


def test_figures_are_drawn_in_the_pages_colours(html):
    """So that dark paper changes them: no colour is left that is not a variable of the page."""
    drawn = html[html.index("</style>") :]
    assert not re.findall(r'style="[^"]*#[0-9a-f]{3,6}', drawn)
    used = set(re.findall(r"var\(--([\w-]+)\)", html))
    assert {"ink", "ik", "policy", "sea-3", "paper"} <= used <= set(palette.COLOURS)
    for k in (0, 1):
        assert f"--ik:{palette.COLOURS['ik'][k]};" in html


def test_table_has_evaluates_numbers(made, html):
    out, run = made
    who, controller = load_controller(str(run))
    both = evaluate_beside_ik(
        who, controller, TASK, MotionConfig(sea="Wb"), episodes=EPISODES, seed=SEED
    )
    stored = json.loads((out / "results.json").read_text())
    assert stored["rows"] == [row for part in both for row in part]
    cells = Page(html).cells
    for (row,) in both:
        for unit in ("pos_mm", "ang_mrad"):
            assert f"{row[unit]['mean']:.2f} ± {row[unit]['std']:.2f}" in cells
    for group in ("all", "top5", "top1", "max"):
        assert f"{round(100 * both[1][0]['improvement']['pos'][group])}" in cells
    assert "-0" not in cells


def test_the_papers_figures_stand_in_its_own_world_only(made, html):
    paper = table3()["E2", "Wb"]
    rows = json.loads((made[0] / "results.json").read_text())["rows"]
    cells = Page(table({"ik": rows[:1], "run": rows[1:]}, papers_world=True)).cells
    for name in ("pos_mm", "ang_mrad"):
        assert f"{paper[f'ik_{name}_implied']:.2f}" in cells
        assert f"{paper[f'{name}_mean']:.2f} ± {paper[f'{name}_std']:.2f}" in cells
    # The report above is of the quiet integrator.
    page = Page(html)
    assert not [cell for cell in page.cells if "paper" in cell]
    assert "The paper has no figures for this task" in page.text and "diamond" not in page.text


@pytest.mark.slow
def test_noise_sweep_has_evaluates_numbers(made, html):
    """A level of the sweep is `evaluate --noise-mm X --noise-mrad X`: the same noise, to the digit;
    the level 0 is the table above it."""
    out, run = made
    stored = json.loads((out / "results.json").read_text())
    swept = {(row["who"], row["noise_mm"]): row for row in stored["noise"]}
    assert [level for who, level in swept if who == "ik"] == [0, 0.3, 1, 3]
    noisy = dataclasses.replace(TASK, conditions=ConditionsConfig(noise_mm="1", noise_mrad="1"))
    who, controller = load_controller(str(run))
    ideal = [row for row in stored["rows"] if row["sea"] == "Wb"]
    at_1 = evaluate_beside_ik(
        who, controller, noisy, MotionConfig(sea="Wb"), episodes=EPISODES, seed=SEED
    )
    for name, clean, (row,) in zip(("ik", "tiny-s0"), ideal, at_1, strict=True):
        for unit in ("pos_mm", "ang_mrad"):
            assert swept[name, 0][unit] == pytest.approx(clean[unit]["mean"], abs=2e-3)
            assert swept[name, 1][unit] == pytest.approx(row[unit]["mean"], abs=2e-3)
            assert swept[name, 3][unit] > swept[name, 0][unit] + 0.05
            assert f"{swept[name, 0.3][unit]:.2f}" in Page(html).cells
        assert {row["sea"] for row in stored["noise"]} == {"Wb"}


@pytest.mark.slow
def test_without_the_noise_sweep_nothing_of_an_earlier_one_is_left(made, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(made[0], out)
    main([str(made[1]), "--out", str(out), "--sea", "Wb", *OPTIONS])
    assert not list(out.glob("noise_*.png")) and (out / "torque.png").exists()
    assert json.loads((out / "results.json").read_text())["noise"] == []
    assert "Measurement noise" not in (out / "index.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_other_levels_of_noise_are_the_same_program():
    env = evaluation_env(TASK, MotionConfig(sea="Wb"))
    ik = load_controller("ik")[1]
    (first,) = noise_sweep(env, ik, ("ik",), sea=0, episodes=1, seed=0, levels=(0, 1))
    before = episodes._compiled()._cache_size()
    (second,) = noise_sweep(env, ik, ("ik",), sea=0, episodes=1, seed=1, levels=(0, 20))
    assert episodes._compiled()._cache_size() == before
    assert second.pos_mm[1] > 1.5 * second.pos_mm[0] and first.pos_mm[1] < 2 * first.pos_mm[0]


@pytest.mark.slow
def test_recorded_episode_is_evaluates(made):
    _, run = made
    who, controller = load_controller(str(run))
    env = evaluation_env(TASK, MotionConfig(sea="Wb"))
    both = errors_beside_ik(who, controller, env, episodes=EPISODES, seed=SEED)
    series = record(env, controller, episode=0, episodes=EPISODES, seed=SEED, sea=0)
    for errors, episode in zip(both, series, strict=True):
        np.testing.assert_allclose(episode.pos_error_m, errors.pos_m[:, 0, 0], atol=2e-5)
        np.testing.assert_allclose(episode.ang_error_rad, errors.ang_rad[:, 0, 0], atol=2e-5)
        apart = np.linalg.norm(episode.goal_m - episode.tool_m, axis=1)
        np.testing.assert_allclose(apart, episode.pos_error_m, atol=2e-6)
        assert np.all(np.abs(episode.torque_nm) <= torque_limits_nm(env.model) * (1 + 1e-6))
    assert not series[0].correction.any() and series[1].correction.any()
    # The queue of two steps, seen from outside: 40 ms, half a hold and the servo.
    lag = lag_s(series[0].goal_m[30:], series[0].tool_m[30:])
    assert 0.04 < lag < 0.07, lag


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def test_replaces_its_own_files_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    write(check_out(str(out)), "<p>1", {"a": b"1", "b": b"1"}, {"rows": [0.1, "\udcff"]})
    (out / ".hidden").write_bytes(b"mine")
    first = contents(out)
    write(check_out(str(out)), "<p>2", {"a": b"2"}, {"rows": []})
    second = contents(out)
    assert sorted(second) == [".hidden", "a.png", "index.html", "results.json"]
    assert second[".hidden"] == b"mine" and second["a.png"] == b"2"
    assert second["index.html"] != first["index.html"]


CHANGES = {
    "holiday.png": lambda out: (out / "holiday.png").write_bytes(b"mine"),
    "notes": lambda out: (out / "notes").mkdir(),
    "index.html": lambda out: (out / "index.html").write_text("edited"),
    "a.png": lambda out: ((out / "a.png").unlink(), (out / "a.png").symlink_to(out / "b.png")),
    "results.json": lambda out: (out / "results.json").write_text('{"kind": "mcx_jax report"}'),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_no_report_wrote_is_refused_and_stays(tmp_path, name):
    out = tmp_path / "out"
    write(out, "<p>1", {"a": b"1", "b": b"1"}, {})
    CHANGES[name](out)
    before = sorted((p.name, p.is_dir() or p.read_bytes()) for p in out.iterdir())
    with pytest.raises(UserError, match=f"--out {out}: holds .*, which no report wrote, or which"):
        check_out(str(out))
    if name not in ("holiday.png", "notes"):  # of those names the report has no file
        with pytest.raises(UserError, match="which no report wrote"):
            write(out, "<p>2", {"a": b"2"}, {})
    else:
        write(out, "<p>1", {"a": b"1", "b": b"1"}, {})
    assert before == sorted((p.name, p.is_dir() or p.read_bytes()) for p in out.iterdir())


def test_a_manifest_cannot_name_files_elsewhere(tmp_path):
    out, mine = tmp_path / "out", tmp_path / "mine"
    mine.write_bytes(b"1")
    write(out, "<p>1", {"../mine": b"1"}, {})
    os.rename(tmp_path / "mine.png", mine)
    text = (out / "results.json").read_text().replace("../mine.png", "../mine")
    (out / "results.json").write_text(text)
    write(check_out(str(out)), "<p>2", {}, {})
    assert mine.read_bytes() == b"1"


def test_a_report_holds_no_nan(tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        write(tmp_path / "out", "", {}, {"rows": [float("nan")]})
    assert not list((tmp_path / "out").iterdir())


def refused(argv, message):
    with pytest.raises(UserError) as error:
        main(argv)
    assert str(error.value) == message


def test_refusals(made, tmp_path):
    _, run = made
    out = str(tmp_path / "out")
    refused(
        ["nobody", "--out", out],
        "unknown controller 'nobody': use ik, extrapolate, extrapolate-best, fir, "
        "preview, shipped:DELAY, a run directory or a policy .npz",
    )
    refused(
        ["--out", out],
        "name at least one RUN: ik, extrapolate, fir, shipped:DELAY, a run directory or .npz",
    )
    refused(["ik"], "--out is missing: name a directory for the report")
    file = tmp_path / "file"
    file.write_text("")
    refused(["ik", "--out", str(file)], f"--out {file}: is a file; name a directory")
    refused(["ik", "--out", f"{file}/out"], f"--out {file}/out: cannot write in {file}")
    refused(["ik", "--out", out, "--show", "50"], "--show 50: must be 0 to 49 (--episodes)")
    other = make_run(tmp_path / "E0-tiny-s0", dataclasses.replace(TASK, delay="E0"))
    refused(
        [str(run), str(other), "--out", out],
        "the runs differ in --delay (E2-tiny-s0 E2, E0-tiny-s0 E0); choose one with --delay",
    )
    assert not (tmp_path / "out").exists()
    both = entries.load_entries(entries.check_names([str(run), str(other)]))
    chosen = entries.common_settings(both, ["--delay", "E1"])
    assert chosen["integrator"] == "implicitfast"


def test_without_matplotlib_one_clear_line(made, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    refused(
        [str(made[1]), "--out", str(tmp_path / "out")],
        f"report needs matplotlib: {extras.install('viz')}",
    )


def test_learning_curves_over_seeds(made):
    curves = entries.learning_curves(made[1])
    assert curves is not None
    np.testing.assert_array_equal(curves.steps, [1000, 2000])
    np.testing.assert_array_equal(curves.wall_s, [60, 120])
    np.testing.assert_array_equal(curves.pos_mm, [[8, 4], [9, 5]])
    np.testing.assert_array_equal(curves.ang_mrad, [[4, 2], [5, 3]])


def test_a_known_delay_is_found():
    t = 0.02 * np.arange(500)
    track = lambda t: np.stack([np.sin(1.7 * t), np.sin(2.9 * t), np.cos(0.8 * t)], 1)  # noqa: E731
    assert lag_s(track(t), 0.01 + track(t - 0.037)) == pytest.approx(0.037, abs=0.0015)
    assert lag_s(track(t), track(t + 0.015)) == pytest.approx(-0.015, abs=0.0015)


def test_torque_limits_add_over_a_joints_actuators():
    from mcx_jax.arm.model import chain_model, load_mujoco

    # Two servos a joint, each +-330, 330, 150, 56, 56, 56 N m (authors' code).
    limits = torque_limits_nm(chain_model(load_mujoco("paper"), "tool"))
    np.testing.assert_allclose(limits, [660, 660, 300, 112, 112, 112])


def test_spectra_of_the_tables_are_the_target():
    from mcx_jax.sea.spectrum import parse_sea
    from mcx_jax.sea.tables import build_tables

    knots = build_tables([parse_sea("Wa"), parse_sea("2.0:9")], "test").knots
    for s in motion_spectra(knots, ("Wa-coupled", "2.0:9"), generated=True):
        np.testing.assert_allclose(s.measured_std, s.target_std, rtol=0.01)
        inside = (s.frequency_hz > 0.25) & (s.frequency_hz < 0.8)
        wanted = np.stack([np.interp(s.frequency_hz[inside], s.target_hz, x) for x in s.target])
        strong = wanted > 0.05 * wanted.max(axis=1, keepdims=True)
        ratio = (s.measured[:, inside] / wanted)[strong]
        assert abs(np.median(ratio) - 1) < 0.05 and np.all((ratio > 0.4) & (ratio < 2)), ratio


@pytest.mark.parametrize(
    ("places", "moved"),
    [
        ([0.1, 0.9], [0.1, 0.9]),
        ([0.5, 0.5], [0.4, 0.6]),
        ([0.8, 0.1, 0.85], [0.725, 0.1, 0.925]),
        ([0.5, 0.5, 0.5, 0.0], [0.3, 0.5, 0.7, 0.0]),
    ],
)
def test_labels_moved_apart(places, moved):
    assert style.spread(places, 0.2) == pytest.approx(moved)


HOSTILE = ("a$x^$b <i>&amp; #123456", 'style="fill:#123456" 船{_', "x" * 300)


@pytest.mark.parametrize("name", HOSTILE)
def test_any_name_is_drawn_as_it_is(name):
    """No markup of matplotlib's, XML's or HTML's is read in a name; a long one is shortened."""
    assert len(style.short(name)) == min(len(name), style.LONGEST_NAME)
    x, ik = np.arange(1.0, 4.0), palette.LIGHT["ik"]
    curve = figures.Line(name, ik, x, x)
    drawn = [
        figures.boxes("", [("", [figures.box(name, ik, x)])], "x"),
        figures.lines("", [curve], "x", "y", level=(name, ik, 2.0)),
        figures.levels("", [curve], "x", "y"),
        figures.follow(
            style.short(name), x, [(name, ik, x), (name, ik, x), (name, ik, x)], "y", (1, 2, 1)
        ),
        figures.spectrum("", [(style.short(name), palette.SEAS[0], x / 4, x, x, x)], "y"),
    ]
    for figure in drawn:
        assert style.png(figure).startswith(b"\x89PNG")
        assert style.short(name) in Page(style.svg(figure, "x", name)).text
    whole = Page(page(name, name, [name], [Section(name, [], name)], {name: name}))
    assert whole.text.count(name) >= 7 and whole.open == []


def test_names_that_are_no_text_are_escaped(tmp_path, monkeypatch):
    monkeypatch.setattr(entries, "load_controller", lambda who: (who, None))
    monkeypatch.setattr(entries, "policy_path", lambda who: None)
    (one,) = entries.load_entries([os.fsdecode(b"run-\xff\n")])
    assert one.label == r"run-\udcff\n"
    page("a\udcff", "", [], [], {"command": "\udcff"}).encode()


def test_every_controller_is_in_the_episodes_figures(monkeypatch):
    x = np.linspace(0.0, 1.0, 90)
    track = np.stack([np.sin(5 * x)] * 3, 1)
    ik = Episode(track, track, track, x, x, np.zeros((90, 6)), np.ones((90, 1)))
    monkeypatch.setattr(build, "record", lambda *_, **__: (ik, ik))
    names = ["ik", "extrapolate", "fir", "run"]
    made = [entries.Entry(n, n, None, {}, n == "run", None) for n in names]
    env = SimpleNamespace(motion=SimpleNamespace(seas=("Wd",)), model=None)
    monkeypatch.setattr(build, "torque_limits_nm", lambda model: np.array([100.0]))
    config = SimpleNamespace(show=0, episodes=1, seed=0, env=TASK)
    said = []
    tracking, effort = build._episode_sections(
        config, env, made, palette.controllers(names), said.append
    )
    assert [p.name for p in tracking.panels[:4]] == [f"follow_{k}" for k in range(4)]
    assert said == [f"recording one episode of {name}" for name in names[1:]]
    curves = {p.name: Page(style.svg(p.figure, "x", "")).text for p in tracking.panels}
    for name in names:
        assert name in curves["episode_dp"] and name in tracking.caption


def test_learning_curves_say_that_they_explore():
    """The finished policy's error, without exploration, is on the figure beside ik's."""
    x = np.array([1e6, 2e6])
    curves = entries.Curves(x, x / 1e5, np.array([[9.0, 6.0]]), np.array([[3.0, 2.0]]))
    colours = palette.controllers(["ik", "run"])
    final = {"ik": {"pos_mm": 5.0, "ang_mrad": 4.0}, "run": {"pos_mm": 1.0, "ang_mrad": 0.5}}
    section = sections.learning([("run", curves)], colours, final)
    assert "noise of exploration in every action" in section.caption
    axes = section.panels[0].figure.axes[0]
    assert "exploring" in axes.get_title(loc="left")
    marks = [line for line in axes.lines if line.get_marker() == "D"]
    assert [tuple(np.ravel(m.get_xydata())) for m in marks] == [(2.0, 1.0)]
    without = sections.learning([("run", curves)], colours, {})
    assert "iamond" not in without.caption and len(without.panels[0].figure.axes[0].lines) == 1


@pytest.mark.parametrize(("width_px", "dark"), [(1280, False), (390, True)])
def test_a_browser_shows_it(made, tmp_path, width_px, dark):
    """Every figure drawn, nothing cut off or wider than the window, no complaint, contents work."""
    with browser.tab(tmp_path / "profile", width_px, dark=dark) as tab:
        tab.page.goto((made[0] / "index.html").as_uri())
        assert tab.sideways_px() <= 0 and tab.cut_off() == []
        picture = tab.picture()
        paper = palette.COLOURS["paper"][dark]
        assert tuple(picture[-1, -1]) == tuple(bytes.fromhex(paper[1:]))
        assert not browser.blank(picture)
        sizes = "all => all.map(e => e.getBoundingClientRect().height)"
        heights = tab.page.locator("svg").evaluate_all(sizes)
        assert len(heights) == len(list(made[0].glob("*.png"))) and min(heights) > 100
        for link in tab.page.locator("nav a").all():
            link.click()
            target = tab.page.locator(link.get_attribute("href"))
            assert target.inner_text() == link.inner_text()
            tab.page.wait_for_function(IN_SIGHT, arg=link.get_attribute("href"))
    assert tab.complaints == []


IN_SIGHT = """id => {
  const { top, bottom } = document.querySelector(id).getBoundingClientRect()
  return top >= 0 && bottom <= innerHeight
}"""

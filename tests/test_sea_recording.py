"""Recorded motion: formats, units, scale, and one clear line for every bad file."""

import jax
import numpy as np
import pytest

from mcx_jax.config.task import MotionConfig
from mcx_jax.config.training import TrainConfig
from mcx_jax.envs.motion import draw_track, load_motion
from mcx_jax.errors import UserError
from mcx_jax.sea.recording import MIN_DURATION_S, load_recording, split_recording
from mcx_jax.sea.spectrum import SEAS
from mcx_jax.sea.tables import build_tables

AMPLITUDE = np.array([0.02, 0.01, 0.04, 0.02, 0.05, 0.01])  # m, rad; laboratory scale
OMEGA = np.array([2.0, 2.5, 3.0, 3.5, 4.0, 1.5])  # rad/s
PHASE = np.arange(6.0)


def motion(t):
    """(n,) s -> (n, 6) m and rad, and the rates."""
    angle = OMEGA * t[:, None] + PHASE
    return AMPLITUDE * np.sin(angle), AMPLITUDE * OMEGA * np.cos(angle)


def record(duration_s=130.0, rate_hz=100.0, start_s=0.0):
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    return np.column_stack([t + start_s, motion(t)[0]])


def save(path, data, header=""):
    if path.suffix == ".npy":
        np.save(path, data)
    else:
        np.savetxt(path, data, delimiter=",", header=header, comments="", fmt="%.17g")
    return path


def check(tables, atol=2e-6):
    """The knots are the motion of `record`, whose mean over the record was taken off."""
    knots = tables.knots[0].astype(float)
    x, xd = motion(np.arange(len(knots)) * 0.1)
    offset = np.array([1, 1, 1, 0, 0, 1])
    error = knots[:, :6] - x
    # The means of a sine over 130 s: below 2 amplitude / (omega T) = 3e-4 m; constant by nature.
    assert (abs(error.mean(axis=0)) <= 4e-4 * offset + atol).all()
    np.testing.assert_allclose(error, np.broadcast_to(error.mean(axis=0), x.shape), atol=atol)
    np.testing.assert_allclose(knots[:, 6:], xd, atol=20 * atol)


@pytest.mark.parametrize("name", ["r.npy", "r.csv"])
def test_metres_and_radians(tmp_path, name):
    tables = load_recording(save(tmp_path / name, record()))
    assert tables.knots.shape == (1, 1301, 12) and tables.knots.dtype == np.float32
    assert tables.companion is None and tables.sea_names == (name,)
    check(tables)


def test_header_bom_and_windows_lines(tmp_path):
    path = save(tmp_path / "r.csv", record(), header="t,x,y,z,roll,pitch,yaw")
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n") + b"\r\n")
    check(load_recording(path))


def test_columns_are_found_by_their_names(tmp_path, capsys):
    order = [3, 1, 2, 6, 4, 0, 5]
    names = 'heave, Surge,SWAY,"yaw",roll,time,pitch'
    data = record(rate_hz=50.0)[:, order]
    check(load_recording(save(tmp_path / "r.csv", data, header=names)))
    assert capsys.readouterr().err == ""
    names = names.replace("yaw", "heading")
    check(load_recording(save(tmp_path / "h.csv", data, header=names)))
    assert "heading is read as yaw, which grows to PORT" in capsys.readouterr().err


def earth_log(yaw):
    """The motion of `record` on a ship whose mean heading is `yaw`, with x and y of the earth."""
    data = record()
    x, y = data[:, 1].copy(), data[:, 2].copy()
    data[:, 1] = 400.0 + np.cos(yaw) * x - np.sin(yaw) * y
    data[:, 2] = -90.0 + np.sin(yaw) * x + np.cos(yaw) * y
    data[:, 6] = (data[:, 6] + yaw + np.pi) % (2 * np.pi) - np.pi  # as a compass jumps
    return data


@pytest.mark.parametrize("degrees", [75.0, -20.0, 180.0])
def test_positions_in_earth_axes_are_turned_into_the_heading(tmp_path, capsys, degrees):
    path = save(tmp_path / "r.npy", earth_log(np.radians(degrees)))
    check(load_recording(path, axes="earth"))
    assert "r.npy: x and y turned by " in capsys.readouterr().err


def test_where_the_axes_matter_the_user_is_asked(tmp_path):
    data = record()
    data[:, 6] += np.radians(75.0)
    path = save(tmp_path / "r.npy", data)
    _refused(
        path,
        "the mean yaw is 75 deg; are x and y along the earth's axes, from which yaw is counted "
        "(give --motion-axes earth), or along the ship's (ship)?",
    )
    check(load_recording(path, axes="ship"))
    data[:, 6] -= np.radians(71.0)
    check(load_recording(save(tmp_path / "r.npy", data)))  # 4 deg: nearly the same thing


def test_drift_and_a_forgotten_scale_are_pointed_out(tmp_path, capsys):
    load_recording(save(tmp_path / "good.npy", record()))
    assert capsys.readouterr().err == ""
    drifting = record()
    drifting[:, 2] += 0.25 * np.sin(2 * np.pi * drifting[:, 0] / 38.0)  # station keeping, 120 s
    load_recording(save(tmp_path / "drifting.npy", drifting))
    assert "drifting.npy: y: most of this motion is slower than 10 s" in capsys.readouterr().err
    full = record()
    full[:, 1:4] *= 20.0
    load_recording(save(tmp_path / "full.npy", full))
    said = capsys.readouterr().err
    assert "moves up to 0.8" in said and "is it at full scale (--motion-scale 10)?" in said
    load_recording(save(tmp_path / "under_way.npy", full), scale=1.02)
    assert "is the scale right?" in capsys.readouterr().err


def test_authors_format(tmp_path):
    # .npy, mm, degrees, 100 Hz, already scaled, float32; hours into a run
    data = record(start_s=3000.0)
    data[:, 1:4] *= 1e3
    data[:, 4:] = np.degrees(data[:, 4:])
    path = save(tmp_path / "r.npy", data.astype(np.float32))
    # float32 stamps and values: 4e-6 of 40 mm; the time stamps are made even again
    check(load_recording(path, length_unit="mm", angle_unit="deg"), atol=1e-5)


def test_froude_scale(tmp_path):
    data = record()
    data[:, 0] *= np.sqrt(10.0)
    data[:, 1:4] *= 10.0
    check(load_recording(save(tmp_path / "full.npy", data), scale=10.0))
    # accelerations: 10 m / 10 s^2 = 1, angles stay
    with pytest.raises(UserError, match="sample rate 31.6 Hz|too short") as error:
        load_recording(save(tmp_path / "full.npy", data), scale=20.0)
    assert "it needs at least 128 s" in str(error.value)  # 411 s / sqrt 20 = 92 s


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_shortest_recording_holds_a_training_episode(tmp_path, split):
    path = save(tmp_path / "short.npy", record(MIN_DURATION_S, 20.0))
    load_motion(MotionConfig(motion=str(path)), TrainConfig().env.episode_steps, split)


def test_lowest_rate_is_accepted(tmp_path):
    # 10 Hz: the cubic spline of a 4 rad/s sine errs by (w h)^4 / 384 = 7e-5 of 5 cm = 3e-6, and
    # more at its natural ends, which only the mean of this check would see: look inside.
    tables = load_recording(save(tmp_path / "slow.npy", record(rate_hz=10.0)))
    knots = tables.knots[0].astype(float)
    x, xd = motion(np.arange(len(knots)) * 0.1)
    inside = slice(10, -10)
    np.testing.assert_allclose(knots[inside, 3:5], x[inside, 3:5], atol=1e-6)
    np.testing.assert_allclose(knots[inside, 6:], xd[inside], atol=2e-4)


def test_constant_offsets_go_but_list_and_trim_stay(tmp_path):
    data = record()
    data[:, 1:] += [100.0, -50.0, 3.0, 0.04, -0.02, np.pi]
    data[:, 6] = (data[:, 6] + np.pi) % (2 * np.pi) - np.pi  # a compass that jumps at 180 deg
    tables = load_recording(save(tmp_path / "r.npy", data), axes="ship")
    mean = tables.knots[0, :, :6].mean(axis=0)
    np.testing.assert_allclose(mean, [0, 0, 0, 0.04, -0.02, 0], atol=1e-3)  # see `check`
    assert abs(tables.knots[0, :, 5]).max() < 0.011


def windows(tmp_path, capsys, duration_s):
    """Test motion of a recording so long, and what was said of it."""
    path = save(tmp_path / f"{duration_s:.0f}.npy", record(duration_s, 20.0))
    motion = load_motion(MotionConfig(motion=str(path)), 1000, "test")
    return motion, capsys.readouterr().err


def test_independent_windows_of_a_short_recording_are_counted(tmp_path, capsys):
    motion, said = windows(tmp_path, capsys, 139.0)  # 26.4 s to test: starts of 0 to 4.3 s
    assert motion.independent_windows(1000) == 1 and motion.apart_steps == 0
    assert "139.npy: the test part holds 1 independent windows of 20 s; below 20 " in said
    assert "should have 420 s of laboratory time" in said
    assert "both vessels move nearly alike" in said
    motion, said = windows(tmp_path, capsys, 1330.0)  # 423 s, of which 2 s are looked ahead
    assert motion.independent_windows(1000) == 21
    assert said.endswith("the test part holds 21 independent windows of 20 s\n")
    load_motion(MotionConfig(sea="Wa"), 1000, "test")
    assert capsys.readouterr().err == ""


def test_windows_of_a_recording_are_15_s_apart_where_it_is_long_enough(tmp_path, capsys):
    motion, _ = windows(tmp_path, capsys, 270.0)  # starts of 0 to 48 s
    uniform = jax.random.uniform(jax.random.key(0), (20_000, 4))
    track = jax.vmap(draw_track, in_axes=(None, 0))(motion, uniform)
    a, b = np.asarray(track.start_a) // 10, np.asarray(track.start_b) // 10
    assert abs(a - b).min() == 750 and min(a.min(), b.min()) == 0
    assert max(a.max(), b.max()) == motion.last_start
    # Every allowed start of B, given A, is as likely as another: half of them in each half.
    near_start = a < 200  # allowed: a + 750 .. last_start
    middle = (a[near_start] + 750 + motion.last_start) / 2
    assert abs(np.mean(b[near_start] < middle) - 0.5) < 0.05  # 1,700 draws: 0.012, four of them


def test_split_two_thirds_one_third(tmp_path):
    tables = load_recording(save(tmp_path / "r.npy", record(300.0, 20.0)))
    train, test = split_recording(tables)
    np.testing.assert_array_equal(train.knots, tables.knots[:, :2001])  # 0 .. 200 s
    np.testing.assert_array_equal(test.knots, tables.knots[:, 2200:])  # 220 .. 300 s
    short = load_recording(save(tmp_path / "s.npy", record(50.0)), min_duration_s=10.0)
    with pytest.raises(UserError) as error:
        split_recording(short)
    assert str(error.value) == (
        "s.npy: lasts 50 s; a train and a test part need more than 60 s: record longer"
    )


def test_generated_table_survives_the_round_trip(tmp_path):
    knots = build_tables([SEAS["Wd"]], "test").knots[0, :3001].astype(float)
    t = np.arange(len(knots)) * 0.1
    path = save(tmp_path / "r.npy", np.column_stack([t, knots[:, :6]]))
    back = load_recording(path).knots[0]
    inside = slice(20, -20)  # a spline's ends know nothing of what lies beyond
    np.testing.assert_allclose(back[inside, 3:5], knots[inside, 3:5], atol=1e-6)
    # velocity from positions 0.1 s apart: (w h)^4 / 180 at 3-6 rad/s, 0.1 m/s
    np.testing.assert_allclose(back[inside, 6:], knots[inside, 6:], atol=1e-3)


def _edit(change, **kwargs):
    data = record(**kwargs)
    change(data)
    return data


def _put(row, column, value):
    return lambda data: data.__setitem__((row, column), value)


BAD_ARRAYS = {
    "nan": (_edit(_put(4, 2, np.nan)), "y is nan in row 5; all entries must be finite numbers"),
    "inf": (_edit(_put(9, 0, np.inf)), "t is inf in row 10; all entries must be finite numbers"),
    "columns": (record()[:, :6], "has 6 columns; it needs the 7 columns t,x,y,z,roll,pitch,yaw"),
    "flat": (record()[:, 0], "has shape (13001,); it needs the 7 columns"),
    "no rows": (record()[:0], "too short: fewer than two rows; it needs at least 128 s"),
    "one row": (record()[:1], "too short: fewer than two rows; it needs at least 128 s"),
    "order": (_edit(_put(7, 0, 0.01)), "time does not increase at row 8; sort the rows"),
    "uneven": (
        np.delete(record(), slice(500, 503), axis=0),
        "time is uneven: a step of 0.04 s at row 501, 0.0100023 s on average; resample",
    ),
    "short": (
        record(100.0),
        "too short: 100.0 s (after Froude scaling); it needs at least 128 s",
    ),
    "slow": (
        record(rate_hz=5.0),
        "sample rate 5 Hz (after Froude scaling); at least 10 Hz are needed: record faster",
    ),
    "milliseconds": (
        _edit(lambda d: d.__imul__([1e3, 1, 1, 1, 1, 1, 1])),
        "sample rate 0.1 Hz (after Froude scaling); at least 10 Hz are needed: record faster, t is",
    ),
    "roll": (_edit(_put(50, 4, 300.0)), "roll reaches 300 rad; at most 0.785 rad can be: is it in"),
    "degrees": (
        _edit(lambda d: d.__imul__([1, 1, 1, 1, 57.3, 57.3, 57.3])),
        "roll reaches 1.146 rad; at most 0.785 rad can be: is it in degrees?",
    ),
    "millimetres": (
        _edit(lambda d: d.__imul__([1, 1e3, 1e3, 1e3, 1, 1, 1])),
        "x moves 20.13 m from its mean; at laboratory scale at most 10 m can be: is it in mm, at "
        "full scale (give --motion-scale, e.g. 10), or under way (take speed and drift off with",
    ),
    "complex": (np.zeros((9, 7), complex), "not readable as .npy array of numbers"),
    "pickle": (np.array([[{}] * 7]), "not readable as .npy array of numbers (pickled objects are"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_bad_arrays(tmp_path, case):
    data, message = BAD_ARRAYS[case]
    path = tmp_path / "bad.npy"
    np.save(path, data, allow_pickle=True)
    _refused(path, message)


BAD_BYTES = {
    "empty.npy": (b"", "the file is empty; it needs columns t,x,y,z,roll,pitch,yaw"),
    "empty.csv": (b"", "the file is empty; it needs columns t,x,y,z,roll,pitch,yaw"),
    "blank.csv": (b"\n\n", "holds no numbers; it needs columns t,x,y,z,roll,pitch,yaw"),
    "header.csv": (b"t,x,y,z,roll,pitch,yaw\n", "holds no numbers; it needs columns t,x,y,z,roll"),
    "random.npy": (bytes(range(256)), "not readable as .npy array of numbers"),
    "cut.npy": (b"\x93NUMPY\x01\x00", "not readable as .npy array of numbers"),
    "random.csv": (bytes(range(256)), "not readable as .csv text; it needs lines of 7 numbers"),
    "text.csv": (
        b"t,x,y,z,roll,pitch,yaw\n1,2,0,0,0,0,0\n3,abc,0,0,0,0,0\n",
        "not all entries are numbers (could not convert string",
    ),
    "unit.csv": (
        b"t,x,y,z,roll,pitch,yaw\ns,m,m,m,rad,rad,rad\n0,0,0,0,0,0,0\n",
        "not all entries are numbers (could not convert string to float: 's')",
    ),
    "unknown.csv": (
        b"ms,surge,sway,heave,roll,pitch,yaw\n0,0,0,0,0,0,0\n",
        "column 'ms' is not known; name the columns, with commas between them and in any order, t "
        "(or time), x (surge), y (sway), z (heave), roll, pitch, yaw (heading)",
    ),
    "with_unit.csv": (b"t,x [mm],y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n", "column 'x [mm]' is not"),
    "twice.csv": (b"t,x,surge,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n", "column 'surge' is a second x"),
    "missing.csv": (b"t,x,y,z,roll,pitch\n0,0,0,0,0,0\n", "the header names no column yaw; needed"),
    "longer.csv": (
        b"t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0,0\n",
        "the header names 7 columns, a line has 8",
    ),
    "ragged.csv": (
        b"0,0,0,0,0,0,0\n0,0,0\n",
        "data line 2 has 3 columns, the first has 7; every line needs t,x,y,z,roll,pitch,yaw",
    ),
    "semicolon.csv": (
        b"0;0;0;0;0;0;0\n1;0;0;0;0;0;0\n",
        "column '0;0;0;0;0;0;0' is not known; name the columns, with commas between them",
    ),
    "log.txt": (b"0,0,0,0,0,0,0\n", "unknown kind of file; a recording is .npy or .csv"),
}


@pytest.mark.parametrize("name", BAD_BYTES)
def test_bad_files(tmp_path, name):
    content, message = BAD_BYTES[name]
    path = tmp_path / name
    path.write_bytes(content)
    _refused(path, message)


def test_missing_file_and_folder(tmp_path):
    _refused(tmp_path / "none.npy", "no such file; give a .npy or .csv recording")
    (tmp_path / "folder.npy").mkdir()
    _refused(tmp_path / "folder.npy", "no such file; give a .npy or .csv recording")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan")])
def test_impossible_scale(tmp_path, scale):
    path = save(tmp_path / "r.npy", record())
    with pytest.raises(UserError, match="the Froude scale is .*; it must be positive, e.g. 10"):
        load_recording(path, scale=scale)


def _refused(path, message):
    """One line that begins with the path and says `message`."""
    with pytest.raises(UserError) as error:
        load_recording(path)
    text = str(error.value)
    assert text.startswith(f"{path}: {message}"), text
    assert "\n" not in text

"""Command lines generated from the configuration dataclasses, and configurations as JSON.

tyro draws boxes around its error messages and explains at length; here every mistake is one line
(`UserError`) that names the flag and what is allowed. Nothing here imports JAX.
"""

import contextlib
import dataclasses
import io
import json
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import tyro

from mcx_jax.errors import UserError, reason

Config = TypeVar("Config")

FORMAT = 1
"""Version of config.json."""


def parse(
    config_type: type[Config], argv: Sequence[str], *, prog: str, default: Config | None = None
) -> Config:
    """Read a command line into a dataclass; nested dataclasses have flat flags.

    Args:
        config_type: the dataclass; field docstrings are the help texts.
        argv: without the program's name.
        prog: name of the command in `--help` (`python -m mcx_jax.<prog>`).
        default: defaults other than the class's own.

    Raises:
        UserError: unknown flag, missing value, value of the wrong kind or out of range, a flag
            given twice.
    """
    _refuse_repeats(argv)
    kwargs: dict[str, Any] = {} if default is None else {"default": default}
    said = io.StringIO()
    _check_names(argv)
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(
                config_type,
                args=list(argv),
                prog=f"python -m mcx_jax.{prog}",
                config=(tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes),
                **kwargs,
            )
    except SystemExit as stop:
        if stop.code in (0, None):  # --help
            raise
        raise UserError(_one_line(said.getvalue())) from None


def _check_names(argv: Sequence[str]) -> None:
    """Checkpoints, JSON and the terminal take no name that is not text; every relative name needs
    a working directory."""
    try:
        here = os.getcwd()
    except FileNotFoundError:
        raise UserError("the working directory has been deleted; change to another one") from None
    for name in (*argv, here):
        try:
            name.encode()
        except UnicodeEncodeError:
            raise UserError(f"{name}: is not UTF-8; use a name that is") from None


def _refuse_repeats(argv: Sequence[str]) -> None:
    """tyro takes the last of two values in silence; which of them is meant only the user knows."""
    given: set[str] = set()
    for word in argv:
        if not word.startswith("--"):
            continue
        flag = word.split("=", 1)[0].replace("_", "-").replace("--no-", "--", 1)
        if flag in given:
            raise UserError(f"{flag} is given twice; leave one of them out")
        given.add(flag)


def flags(config: Any, default: Any, leave_out: tuple[str, ...] = ()) -> list[str]:
    """The command line that `parse` reads as `config`.

    Args:
        config: a dataclass of settings, without positional ones.
        default: of the same class; what is equal there is left out.
        leave_out: names of fields.
    """
    words: list[str] = []
    for name in (f.name for f in dataclasses.fields(config) if f.name not in leave_out):
        ours, theirs = getattr(config, name), getattr(default, name)
        flag = name.replace("_", "-")
        if dataclasses.is_dataclass(ours):
            words += flags(ours, theirs, leave_out)
        elif ours != theirs and isinstance(ours, bool):
            words.append(f"--{flag}" if ours else f"--no-{flag}")
        elif ours != theirs:
            words += [f"--{flag}", str(ours)]
    return words


def _one_line(box: str) -> str:
    """Extract tyro's message and rephrase its Python-level errors."""
    text = _box_text(box)
    if match := re.search(r"Error parsing (--\S+): invalid literal for int.*: '(.*)'", text):
        return f"{match[1]} {match[2]}: must be a whole number"
    if match := re.search(
        r"Error parsing (--\S+): could not convert string to float: '(.*)'", text
    ):
        return f"{match[1]} {match[2]}: must be a number"
    if match := re.search(r"invalid choice '(.*?)' for argument '(.*?)'.*\((.*?),?\)", text):
        return f"{match[2]} {match[1]}: use one of {match[3].replace(chr(39), '')}"
    if match := re.match(r"Missing from [^:]*: (?:(--\S+) )?(\S+) (.*?)\(required\)", text):
        # "--out STR what it is" or, without a flag, "RUN what it is"
        return f"{match[1] or match[2]} is missing: {match[3].strip()}"
    if match := re.search(r"Missing value for argument '(.*?)'", text):
        return f"{match[1]} needs a value"
    if match := re.search(r"Unrecognized options: (.*)", text):
        near = re.search(r"Perhaps you meant:\W*(--[\w-]+)", box)
        hint = f"did you mean {near[1]}? " if near else ""
        return f"unknown option {match[1].replace(',', '')}: {hint}--help lists all"
    return text or "the command line could not be read; --help explains it"


def _box_text(box: str) -> str:
    """The message in tyro's box, unwrapped: what is between the title and the next rule.

    Where the output takes no Unicode the box has no sides and the title is a line of its own.
    """
    sections = [[]]
    for line in box.splitlines():
        inner = line.strip().strip("│").strip()
        if inner.startswith(("╭", "╰")):
            continue
        if inner and set(inner) <= set("─-"):
            sections.append([])
        else:
            sections[-1].append(inner)
    message = sections[0] if "╭" in box or len(sections) == 1 else sections[1]
    return " ".join(" ".join(message).split())


def value_of(argv: Sequence[str], flag: str) -> str | None:
    """Value of a flag that other defaults hang on, read before the real parsing, which refuses a
    flag that is given twice; the last of them."""
    value = None
    for i, word in enumerate(argv):
        if word.startswith(f"{flag}="):
            value = word.split("=", 1)[1]
        elif word == flag and i + 1 < len(argv):
            value = argv[i + 1]
    return value


def optional_value(argv: Sequence[str], flag: str, default: str) -> list[str]:
    """argv with `default` put after a flag that has no value."""
    words = []
    for i, word in enumerate(argv):
        words.append(word)
        bare = i + 1 == len(argv) or argv[i + 1].startswith("--")
        if word == flag and bare:
            words[-1] = f"{flag}={default}"
    return words


def check_output(flag: str, path: str) -> None:
    """Refuse, before any work, a file that could not be written at its end, or that is not empty.

    Args:
        path: as given with `flag`; "" (none) and "-" (standard output) are fine.
    """
    if path in ("", "-"):
        return
    target = Path(path)
    check_name(flag, path)
    if not target.parent.is_dir():
        raise UserError(f"{flag} {path}: no such directory")
    if target.is_dir():
        raise UserError(f"{flag} {path}: is a directory; name a file")
    if target.is_file() and target.stat().st_size:
        raise UserError(f"{flag} {path}: exists already; name another file, or remove it")
    if not os.access(target if target.exists() else target.parent, os.W_OK):
        raise UserError(f"{flag} {path}: not writable; choose another file")


def check_name(flag: str, path: str | Path) -> None:
    """Refuse a path that no file can have (too long, say); whether there is one does not matter."""
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        raise UserError(f"{flag} {path}: cannot be used ({reason(error)}); name another") from None


def write_output(flag: str, path: str, text: str) -> None:
    """Write a result to the file that was given with `flag`."""
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(
            f"{flag} {path}: cannot be written ({reason(error)}); choose a writable file"
        ) from None


def config_to_json(config: Any) -> str:
    """A configuration as JSON, with the format's version."""
    return json.dumps({"format": FORMAT, **dataclasses.asdict(config)}, indent=1) + "\n"


def config_from_json(config_type: type[Config], text: str, where: str = "config.json") -> Config:
    """Inverse of `config_to_json`; strict.

    Args:
        where: name of the file, for messages.

    Raises:
        UserError: not JSON, another format, unknown or missing settings, values of the wrong kind.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError):
        raise UserError(f"{where}: not a JSON file, or cut short") from None
    if not isinstance(values, dict) or values.pop("format", None) != FORMAT:
        raise UserError(f"{where}: not a configuration of this version (format {FORMAT})")
    return _build(config_type, values, where)


def _build(config_type: type[Config], values: Any, where: str) -> Config:
    hints = get_type_hints(config_type)
    settings = dataclasses.fields(config_type)  # type: ignore[arg-type]
    names = [f.name for f in settings]
    if not isinstance(values, dict):
        raise UserError(f"{where}: must hold settings, not {values!r}")
    values = {f.name: f.default for f in settings if "added" in f.metadata} | values
    unknown = sorted(set(values) - set(names))
    missing = [name for name in names if name not in values]
    if unknown or missing:
        problem = f"unknown setting {unknown[0]!r}" if unknown else f"no setting {missing[0]!r}"
        raise UserError(f"{where}: {problem}; it was written by another version of mcx_jax")
    checked = {name: checked_value(hints[name], values[name], f"{where}: {name}") for name in names}
    return config_type(**checked)


def checked_value(hint: Any, value: Any, where: str) -> Any:
    """`value` as the type `hint`: a dataclass (or its fields), a Literal, bool, int, float or str.

    Args:
        where: begins the message, e.g. "config.json: seed".

    Raises:
        UserError: it is not.
    """
    if dataclasses.is_dataclass(hint):
        if type(value) is hint:
            return value
        return _build(hint, value, where)  # type: ignore[arg-type]
    if get_origin(hint) is Literal:
        if value not in get_args(hint):
            raise UserError(f"{where} is {value!r}, must be one of {', '.join(get_args(hint))}")
        return value
    if hint is float and type(value) is int:
        try:
            return float(value)
        except OverflowError:
            raise UserError(f"{where} is too large a number") from None
    if type(value) is not hint:
        raise UserError(f"{where} is {value!r}, must be of type {hint.__name__}")
    return value


def difference(ours: Any, theirs: Any) -> str | None:
    """First setting in which two configurations differ, as '--flag ours, not theirs'; None: equal.

    `theirs` is what was asked for.
    """
    for field in dataclasses.fields(ours):
        a, b = getattr(ours, field.name), getattr(theirs, field.name)
        if dataclasses.is_dataclass(a):
            found = difference(a, b)
            if found:
                return found
        elif a != b:
            return f"--{field.name.replace('_', '-')} {a}, not {b}"
    return None

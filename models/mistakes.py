"""Reading and checking files that people write; mistakes are described in the words of the file.

Every message names the file, the field (as a path such as ``sensors.0.unit``), what was expected, what was found, and
the name that was probably meant. The checks themselves are fields and validators of the models.
"""

import difflib
import os
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import is_dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from models.errors import MachineFileError

_Model = TypeVar("_Model", bound=BaseModel)
_Place = tuple[int | str, ...]
_LONGEST_SHOWN = 80
_MOST_TOLD = 20
_TYPES = {
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "string": "text in quotes",
    "tuple": "a list in brackets, [...]",
    "list": "a list in brackets, [...]",
    "dict": "a table",
    "model": "a table",
    "dataclass": "a table",
    "path": "the name of a file in quotes",
    "datetime": "a date and time such as 2026-01-31T12:00:00Z",
}
_FORMS: dict[str, str] = {}
_UNREADABLE = (
    (r"Invalid value", "expected a value here; text needs quotes"),
    (r"Cannot overwrite a value", "this name occurs twice"),
    (r"Cannot declare \('(?P<name>.*)',\) twice", "the table {name} occurs twice"),
    (r"Expected newline or end of document after a statement", "expected the end of the line after the value"),
    (r"Unescaped '\\' in a string", "a backslash in text: write / instead, or put the text in single quotes"),
)


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file.

    Raises
    ------
    MachineFileError
        If it cannot be read or is not TOML; the message names the file and, where known, the line.
    """
    try:
        with open(path, "rb", opener=_open_without_waiting) as file:
            data = file.read()
    except FileNotFoundError as error:
        beside = [entry.name for entry in path.parent.glob("*.toml")]
        raise MachineFileError(f"{path}: no such file{did_you_mean(path.name, beside)}") from error
    except IsADirectoryError as error:
        raise MachineFileError(f"{path}: is a folder, expected a file (TOML)") from error
    except OSError as error:
        raise MachineFileError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        text = data.decode("utf-8-sig")  # Windows editors begin a file with a mark of the encoding
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise MachineFileError(f"{path}: line {line}: expected UTF-8, save the file in that encoding") from error
    return parse_toml(text, path)


def _open_without_waiting(path: str, flags: int) -> int:
    """Open a file, also a named pipe, without waiting for somebody who writes into it."""
    descriptor = os.open(path, flags | os.O_NONBLOCK)
    os.set_blocking(descriptor, True)  # a pipe into which somebody writes is read to its end
    return descriptor


def parse_toml(text: str, place: object) -> dict[str, object]:
    """Parse TOML; messages begin with the place, which is the file or the argument.

    Raises
    ------
    MachineFileError
        If it is not TOML; the message names the line where it is known.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise MachineFileError(f"{place}: {_unreadable(str(error), text)}") from error
    except ValueError as error:
        raise MachineFileError(f"{place}: a number has too many digits") from error
    except RecursionError as error:
        raise MachineFileError(f"{place}: lists or tables are nested too deeply") from error


def changed(fields: dict[str, object], changes: str) -> dict[str, object]:
    """Merge changes, in TOML, into the fields of a file: tables name by name, while anything else is replaced.

    Raises
    ------
    MachineFileError
        If they are not TOML.

    Examples
    --------
    >>> changed({"alarms": {"gap_s": 1.0, "on_delay_s": 10.0}}, "alarms.on_delay_s = 60.0")
    {'alarms': {'gap_s': 1.0, 'on_delay_s': 60.0}}
    """

    def over(below: object, above: object) -> object:
        if not isinstance(below, dict) or not isinstance(above, dict):
            return above
        return below | {name: over(below.get(name), one) for name, one in above.items()}

    given = parse_toml(changes, "changes")
    return {**fields, **{name: over(fields.get(name), one) for name, one in given.items()}}


def checked(model: type[_Model], fields: object, place: object) -> _Model:
    """Turn the fields of a file into the record they describe; messages begin with the place, see `parse_toml`.

    Raises
    ------
    MachineFileError
        With one line for each mistake.
    """
    told, found, cause = unseen_mistakes(fields, model), None, None
    try:
        found = model.model_validate(fields)
    except ValidationError as error:
        told += [text for _, text in mistakes(error, model, fields)]
        more = error.error_count() - _MOST_TOLD
        told += [f"and {more} more mistakes"] if more > 0 else []
        cause = error
    if found is None or told:
        raise MachineFileError("\n".join(f"{place}: {text}" for text in told)) from cause
    return found


def unseen_mistakes(fields: object, model: type[BaseModel]) -> list[str]:
    """Mistakes that pydantic does not see.

    True and false in place of a number, which it takes for 1 and 0, and null characters in text, which no name of a
    file or host can have.
    """
    told = []
    for at, value in _leaves(fields):
        if isinstance(value, str) and "\0" in value:
            told.append(f"{_named(at, fields)}expected text without the character 0 (\\u0000)")
        if not isinstance(value, bool):
            continue
        info = _field(at, model)[1]
        kinds = {"bool"} if info is None else set(re.findall(r"\w+", str(info.annotation)))
        kind = next((one for one in ("int", "float") if one in kinds and "bool" not in kinds), None)
        if kind is not None:
            fault = ErrorDetails(type=f"{kind}_type", loc=at, msg="", input=value)
            told.append(f"{_named(at, fields)}{expectation(fault, info)}")
    return told


def _leaves(fields: object, at: _Place = ()) -> Iterator[tuple[_Place, object]]:
    if isinstance(fields, Mapping | list | tuple):
        for name, value in fields.items() if isinstance(fields, Mapping) else enumerate(fields):
            yield from _leaves(value, (*at, name))
    else:
        yield at, fields


def in_folder(model: _Model, folder: Path) -> _Model:
    """Take relative paths in the fields of a file from its folder, also those in its tables and lists."""

    def found(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(found, value))
        if isinstance(value, BaseModel):
            return in_folder(value, folder)
        return folder / value if isinstance(value, Path) else value

    return model.model_copy(update={name: found(getattr(model, name)) for name in type(model).model_fields})


def mistakes(error: ValidationError, model: type[BaseModel], fields: object = None) -> tuple[tuple[_Place, str], ...]:
    """What is wrong, mistake by mistake: place and text, which begins with the place; the first ones of very many.

    `fields` are what was checked; with them a message names the entry of a list.
    """
    found = error.errors(include_url=False)[:_MOST_TOLD]
    texts = defaultdict[_Place, list[str]](list)
    meant: set[_Place] = set()
    for one in found:
        if one["type"] == "extra_forbidden":
            *above, key = one["loc"]
            text, name = _unknown(str(key), tuple(above), model, fields)
            texts[one["loc"]] = [text]
            meant |= {(*above, name)} if name is not None else set()
    for one in found:
        place, info = _field(one["loc"], model)
        within = any(other["loc"][: len(place)] == place and len(other["loc"]) > len(place) for other in found)
        if one["type"] == "extra_forbidden" or place in meant or (one["type"] in {"too_short", "too_long"} and within):
            continue
        told = texts[place]
        if one["type"] == "unexpected_keyword_argument":
            told.append("unknown")
        elif one["type"] == "missing":
            told.append(_missing(place, one["loc"], info))
        elif one["type"] in {"value_error", "assertion_error"}:
            told.append(one["msg"].removeprefix("Value error, "))
        elif told and told[-1].startswith("expected "):  # one of several kinds of value would do
            told[-1] = f"{told[-1].removesuffix(_shown(one))} or {expectation(one, info).removeprefix('expected ')}"
        else:
            told.append(expectation(one, info))
    return tuple((place, f"{_named(place, fields)}{text}") for place, several in texts.items() for text in several)


def expectation(fault: ErrorDetails, info: FieldInfo | None = None) -> str:
    """What was expected and found, for one of `ValidationError.errors`; with its field also both ends of a range."""
    kind, context, value = fault["type"], fault.get("ctx", {}), fault["input"]
    between = "" if info is None else _range(info)
    hint = ""
    if kind in {"greater_than", "greater_than_equal", "less_than", "less_than_equal", "finite_number"}:
        wanted = between or _range_text(**{name: context[name] for name in ("gt", "ge", "lt", "le") if name in context})
        wanted = ", ".join(filter(None, ("a finite number" if kind == "finite_number" else "", wanted)))
    elif kind == "json_invalid":
        return "expected JSON, but it is cut off or damaged"
    elif kind in {"literal_error", "enum"}:
        wanted = context["expected"].replace("'", "")
        names = re.split(r", | or ", wanted)
        wanted = f"one of {', '.join(names)}" if len(names) > 1 else wanted
        hint = did_you_mean(str(value), names)
    elif kind == "string_pattern_mismatch":
        wanted = (info.description if info is not None else None) or _FORMS.get(context["pattern"], "another text")
    elif kind in {"too_short", "too_long", "string_too_short", "string_too_long"}:
        one = "character" if isinstance(value, str) else "entry"
        count = context.get("min_length", context.get("max_length"))
        most = "at least" if kind.endswith("short") else "at most"
        wanted = f"{most} {count} {one}" if count == 1 else f"{most} {count} {one.replace('entry', 'entrie')}s"
    elif kind in {"tuple_type", "list_type"} and info is not None and _models(info.annotation):
        name = ".".join(str(part) for part in fault["loc"])
        wanted = f"tables, each under [[{name}]]"
    else:
        wanted = _TYPES.get("int" if kind == "int_from_float" else kind.partition("_")[0], "something else")
        wanted += f", {between}" if between and "number" in wanted else ""
        described = "" if info is None or info.description is None else f": {info.description}"
        wanted += described if kind.startswith(("tuple", "list")) else ""
    return f"expected {wanted}{_shown(fault)}{hint}"


def form(pattern: str, words: str) -> str:
    """Return a pattern of text, for which `expectation` has words from now on."""
    _FORMS[pattern] = words
    return pattern


def plainly(fault: Mapping[str, Any]) -> str:
    """What is wrong with an argument, a field of a body or of a message; its name goes before it.

    The fault is one of `ValidationError.errors`, or was made elsewhere with only its place and ``msg``.
    """
    kind = fault.get("type", "value_error")
    if kind in {"missing", "extra_forbidden"}:
        return "missing" if kind == "missing" else "unknown"
    if kind in {"value_error", "assertion_error"}:
        return str(fault["msg"]).removeprefix("Value error, ")
    if kind.startswith(("model", "dict")):
        return "expected an object, {...}"
    return expectation(cast("ErrorDetails", fault))


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A clause that names the nearest of the known words; empty if none is near.

    Examples
    --------
    >>> did_you_mean("k_by", ("k_by_N_per_m", "k_bz_N_per_m"))
    '; did you mean k_by_N_per_m?'
    >>> did_you_mean("window", ("height",)), did_you_mean("y", ("y", "z"))
    ('', '')
    """
    name = _nearest(word, known)
    return "" if name in (None, word) else f"; did you mean {name}?"


def argument_text(error: Exception) -> str | None:
    """What was expected of an argument of a command, if a check of a field of a file is the cause of its refusal."""
    cause = error.__cause__
    return expectation(cause.errors(include_url=False)[0]) if isinstance(cause, ValidationError) else None


def _nearest(word: str, known: Iterable[str]) -> str | None:
    by_lower = {name.lower(): name for name in known}
    lower = word.lower()
    # A unit or the kind of a thing left out: k_by, rate, change.
    longer = [name for name in by_lower if f"_{lower}_" in f"_{name}_"]
    near = difflib.get_close_matches(lower, longer or by_lower, 1, 0.0 if longer else 0.6)
    return by_lower[near[0]] if near else None


def _unreadable(message: str, text: str) -> str:
    """Describe why a text is no TOML: the number of the line, what is wrong there, and the line itself."""
    where = re.search(r" \(at line (\d+), column \d+\)$", message)
    if where is None:
        return f"cannot be read as TOML: {message[0].lower()}{message[1:]}"
    number, line = int(where[1]), text.splitlines()[int(where[1]) - 1].strip()
    said = message[: where.start()]
    matches = ((plain, re.fullmatch(pattern, said)) for pattern, plain in _UNREADABLE)
    said = next((plain.format(**match.groupdict()) for plain, match in matches if match), said)
    if re.search(r"=\s*[-+]?\d+,\d", line):
        said = "a number has a decimal point, not a comma"
    return f"line {number}: {said[0].lower()}{said[1:]}: {line[:_LONGEST_SHOWN]}"


def _unknown(key: str, above: _Place, model: type[BaseModel], fields: object) -> tuple[str, str | None]:
    """What to say of a key that is not known, and the key that was meant."""
    owner = _owner(above, model)
    known = [] if owner is None else list(owner.model_fields)
    given = _value(above, fields)
    free = [name for name in known if not isinstance(given, Mapping) or name not in given]
    elsewhere = [table for table, other in _tables(model) if key in other.model_fields and other is not owner]
    if 0 < len(elsewhere) <= 3:
        return f"unknown here; {key} belongs {' or '.join(elsewhere)}", None
    name = _nearest(key, free) or _nearest(key, known)
    if name is not None:
        return f"unknown; did you mean {name}?", name
    return f"unknown; there {'are' if len(known) > 1 else 'is'} {', '.join(known)}", None


def _tables(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """All tables a file may have, and where they are."""
    yield (f"in [{path}]" if path else "at the top of the file"), model
    for name, info in model.model_fields.items():
        for below in _models(info.annotation):
            yield from _tables(below, f"{path}.{name}" if path else name)


def _missing(place: _Place, whole: _Place, info: FieldInfo | None) -> str:
    if info is None:
        return "missing"
    if place != whole:  # an entry of a list that has a certain length
        return f"expected a list of {len(get_args(info.annotation))}: {info.description or 'values'}"
    wanted = ", ".join(filter(None, (info.description, _range(info))))
    return f"missing; expected {wanted}" if wanted else "missing"


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for part in get_args(annotation) for found in _models(part)]


def _has_dataclass(annotation: Any) -> bool:
    return is_dataclass(annotation) or any(map(_has_dataclass, get_args(annotation)))


def _owner(place: _Place, model: type[BaseModel]) -> type[BaseModel] | None:
    """The table at a place."""
    owner: type[BaseModel] | None = model
    for part in place:
        info = None if owner is None else owner.model_fields.get(str(part))
        if info is not None:
            owner = next(iter(_models(info.annotation)), None)
    return owner


def _field(place: _Place, model: type[BaseModel]) -> tuple[_Place, FieldInfo | None]:
    """The field at a place, without the parts that pydantic adds: entries of lists, members of unions."""
    for end in range(len(place), 0, -1):
        owner = _owner(place[: end - 1], model)
        info = None if owner is None else owner.model_fields.get(str(place[end - 1]))
        if info is not None:
            into = _models(info.annotation) or _has_dataclass(info.annotation)
            return (place, None) if end < len(place) and into else (place[:end], info)
    return place, None


def _range(info: FieldInfo) -> str:
    limits = {
        name: value for one in info.metadata for name in ("gt", "ge", "lt", "le")
        if isinstance(value := getattr(one, name, None), int | float)
    }  # fmt: skip
    return _range_text(**limits)


def _range_text(
    gt: float | None = None, ge: float | None = None, lt: float | None = None, le: float | None = None
) -> str:
    if ge is not None and le is not None:
        return f"{ge:.12g} to {le:.12g}"
    low = f"above {gt:.12g}" if gt is not None else f"{ge:.12g} or more" if ge is not None else ""
    high = f"below {lt:.12g}" if lt is not None else f"at most {le:.12g}" if le is not None else ""
    return " and ".join(filter(None, (low, high)))


def _value(place: _Place, fields: object) -> object:
    for part in place:
        if isinstance(fields, Mapping):
            fields = fields.get(part)
        elif isinstance(fields, list | tuple) and isinstance(part, int) and part < len(fields):
            fields = fields[part]
        else:
            return None
    return fields


def _named(place: _Place, fields: object) -> str:
    """Path of the field, with the name of the list entry to which it belongs."""
    names = []
    for end, part in enumerate(place, start=1):
        entry = _value(place[:end], fields)
        name = entry.get("name") if isinstance(part, int) and isinstance(entry, Mapping) else None
        names += [str(name)] if isinstance(name, str) else []
    field = ".".join(str(part) for part in place)
    return f"{field}{f' ({names[-1]})' if names else ''}: " if field else ""


def _shown(fault: ErrorDetails) -> str:
    """The value found, as it stands in a file; nothing long, and no address, which may hold a password."""
    value = fault["input"]
    try:
        text = str(value).lower() if isinstance(value, bool | date) else repr(value)
    except ValueError:  # a number of thousands of digits
        return ""
    return "" if isinstance(value, Mapping) or "://" in text or len(text) > _LONGEST_SHOWN else f" (found {text})"

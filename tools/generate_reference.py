"""Generate docs/site-file.md from the models of the site file and docs/command-line.md from the parser.

``python tools/generate_reference.py`` writes the pages; with ``--check`` it writes nothing and fails when a page is not
what the code gives (``make reference`` and the tests). The prose of the pages stands here.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rayfix.cli import make_parser
from rayfix_offline.site import SiteFile

DOCS = Path(__file__).resolve().parents[1] / "docs"

UNITS = {"deg": "deg", "m": "m", "db": "dB", "ghz": "GHz"}

SITE_HEAD = """\
# The site file

`site.toml` names the scene, says how signals travel, which table to build, and where the stations are. `rayfix example DIR`
writes one to start from; `rayfix check site.toml` finds mistakes. Unknown keys are refused with those that are known. This page
is generated from the code: `make reference`.

A change of the scene, of `[propagation]` or of `[table]` builds all parts of a table again; a change of a station builds that
station's part, or less: [After a change](updates.md). "Time and size" below are those of the build and of the table.
"""

SITE_WINDOWS = """
## Which windows

A window is the standard deviation of the angles that a cell stands for. A measured angle is looked up in the finest level whose
window is at least 1.25 times its own deviation; one level serves every smaller deviation, since the look-up makes up for the rest.
An angle wider than all windows is summed over many cells, which takes longer. Angles of more than 1.28 times the finest window, and times
alone, are integrated on the path map instead, unless a clock is unknown or signal strengths are reported. `rayfix check` tells these
limits of a site. So the finest window decides what the smallest deviations can be worth, the widest what is quick, and what lies
between saves time:

| sensors | deviation of their angles | `windows_deg` |
|---|---|---|
| base stations with many antennas; arrays after calibration | 0.1 to 1 deg | `[1.25, 5, 15]`, the default |
| the same, beside coarse ones | 0.1 to 12 deg | `[1.25, 5, 15]` |
| Silicon Labs arrays, in the open | 1 to 2 deg | `[2.5, 10]` |
| u-blox anchors (10 deg is assumed), arrays among reflections | 4 to 12 deg | `[5, 15]` |
| times alone (UWB, RTOA) | none | `[5, 15]`: components of all directions are merged anyway |

Cells are built at the finest window only; wider ones are sums of them. The number of the finest cells falls with its
square. In the bundled hall, balancing and maps of paths included:

| `windows_deg` | processor time | table |
|---|---|---|
{measured}

So the coarse windows cost about a quarter of the default's time and size. Of each size, 36 MB are the stations' maps of paths, which
depend on no window ([of what a table's size is made](performance.md#the-whole-build)). All deviations up to the finest window
divided by 1.25 are served by it; where they are far below it, edges of what a station sees are less sharp than they could be.
"""

SECTIONS = (
    ("SiteSection", "[site]", "The scene and how to read it."),
    ("RoomSection", "[room]", "An empty room in place of a scene file. Stations may stand on its walls: they are moved off by a millimetre, and `rayfix check` says so."),
    ("PropagationSection", "[propagation]", "The paths, and which of them a station reports; the whole section may be left out."),
    ("MaterialSection", "[materials.NAME]", "NAME is what the scene file calls the material; [Walls](scenes.md#walls)."),
    ("TableSection", "[table]", "Windows and fit of the table; the whole section may be left out."),
    ("StationSection", "[[stations]]", "One section for each base station, anchor or locator. [Mounting](mounting.md) draws its angles."),
    ("BiasSection", "bias of a station", "Measured minus true; the fusion takes it off. [Measurements](measurements.md#bias-of-a-station)."),
    ("AngleBiasSection", "bias that depends on the direction", "Written by `rayfix calibrate`; between the directions of the grid the fusion interpolates. [Calibration](calibration.md)."),
    ("DeviationsSection", "errors of a station's measurements", "Written by `rayfix calibrate`; the fusion takes them instead of what reports state. [Calibration](calibration.md)."),
    ("SelectionSection", "selection of a station", "Which of the paths that it hears a station reports, where reports do not say it. [Selection](selection.md)."),
)  # fmt: skip

COMMAND_HEAD = """\
# The command line

`rayfix COMMAND --help` prints the same. Every error that rayfix foresees is one line on standard error and exit status 2;
`rayfix check` and `rayfix build` with errors of the site exit so, too; an interruption exits with 130. This page is generated from
the code: `make reference`.

| command | does |
|---|---|
"""

WINDOWS_MEASURED = """\
| `[1.25, 5, 15]` | 86 s | 175 MB |
| `[2.5, 10]` | 37 s | 78 MB |
| `[5, 15]` | 22 s | 52 MB |"""
"""By builds of `rayfix example` with these windows, one job and kernels that were compiled before, on busy cores.

Sizes of the second and the third are those of their components and paths, of 67 and 8 bytes."""


def site_page() -> str:
    """Write the page of the site file."""
    schema = SiteFile.model_json_schema()
    lines = [SITE_HEAD]
    for model, title, text in SECTIONS:
        definition = schema["$defs"][model]
        lines += [
            f"\n## {title}\n",
            f"{text}\n",
            "| key | unit | default | limits | meaning | time and size |",
            "|" + "---|" * 6,
        ]
        required = definition.get("required", [])
        for key, field in definition["properties"].items():
            default = "required" if key in required else _toml(field.get("default"))
            cells = (f"`{key}`", _unit(key), default, _limits(field), field["description"], field.get("effect", "none"))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n" + SITE_WINDOWS.format(measured=WINDOWS_MEASURED)


def _unit(key: str) -> str:
    if key.endswith("_s_m"):
        return "S/m"
    return UNITS.get(key.rpartition("_")[2], "") if "_" in key else ""


def _toml(value: Any) -> str:
    match value:
        case None:
            return "not given"
        case bool():
            return f"`{str(value).lower()}`"
        case str():
            return f'`"{value}"`'
        case list():
            return f"`[{', '.join(f'{v:g}' for v in value)}]`"
        case dict():
            return "all 0"
        case _:
            return f"`{value:g}`"


def _limits(field: dict[str, Any]) -> str:
    """Say in words what JSON Schema says of a value."""
    for one in field.get("anyOf", ()):
        if one.get("type") != "null":
            return _limits(one)
    if "enum" in field:
        return ", ".join(f'`"{value}"`' for value in field["enum"])
    if "prefixItems" in field:
        inner = _limits(field["prefixItems"][0])
        return f"{len(field['prefixItems'])} numbers" + (f", each {inner}" if inner else "")
    if "items" in field:
        inner = _limits(field["items"])
        return f"rows of {inner}" if "items" in field["items"] else f"numbers, each {inner}"
    if field.get("type") == "boolean":
        return "`true`, `false`"
    if "$ref" in field or "pattern" in field:
        return ""
    parts: list[str] = []
    low, above = field.get("minimum"), field.get("exclusiveMinimum")
    high, below = field.get("maximum"), field.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{low:g} to {high:g}"
    if low is not None or above is not None:
        parts.append(f"{low:g} or more" if low is not None else f"above {above:g}")
    if high is not None or below is not None:
        parts.append(f"{high:g} at most" if high is not None else f"below {below:g}" if below < 2**40 else "below 2^63")
    if (longest := field.get("maxLength")) is not None:
        parts.append(f"1 to {longest} characters")
    return ", ".join(parts)


def command_page() -> str:
    """Write the page of the command line."""
    parser = make_parser()
    (commands,) = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    helps = {choice.dest: choice.help or "" for choice in commands._choices_actions}
    lines = [COMMAND_HEAD.rstrip()]
    lines += [f"| [`rayfix {name}`](#rayfix-{name}) | {helps[name]} |" for name in commands.choices]
    for name, command in commands.choices.items():
        lines += [
            f"\n## rayfix {name}\n",
            f"{helps[name][0].upper()}{helps[name][1:]}.\n",
            f"<!-- not run: the usage, with names for arguments -->\n```sh\n{_usage(command)}\n```\n",
        ]
        lines += ["| argument | meaning |", "|---|---|"]
        lines += [f"| {form} | {text} |" for form, text in _arguments(command)]
    return "\n".join(lines) + "\n"


def _usage(command: argparse.ArgumentParser) -> str:
    """Positional arguments and required options; the table has the others."""
    words = []
    for action in command._actions:
        if action.option_strings and action.required:
            words.append(f"{action.option_strings[0]} {_metavar(action)}")
        elif not action.option_strings:
            name = _metavar(action)
            words.append({"?": f"[{name}]", "+": f"{name} [{name} ...]"}.get(str(action.nargs), name))
    more = any(action.option_strings and not action.required for action in command._actions if action.dest != "help")
    return " ".join([command.prog, *words, *["[options]"] * more])


def _arguments(command: argparse.ArgumentParser) -> Iterator[tuple[str, str]]:
    for action in command._actions:
        if isinstance(action, argparse._HelpAction):
            continue
        value = f" {_metavar(action)}" if action.nargs != 0 else ""
        form = ", ".join(f"`{option}{value}`" for option in action.option_strings) or f"`{_metavar(action)}`"
        if not action.option_strings and action.nargs == "?":
            form += ", may be left out"
        text = (action.help or "").replace("%%", "%").replace("|", "\\|")
        if action.choices and action.metavar is None and action.option_strings:
            text = f"{text}: {', '.join(f'`{choice}`' for choice in action.choices)}"
        yield form.replace("|", "\\|"), text


def _metavar(action: argparse.Action) -> str:
    if isinstance(action.metavar, tuple):
        return " ".join(action.metavar)
    if action.metavar is not None:
        return str(action.metavar)
    if action.choices:
        return "VALUE" if action.option_strings else "|".join(str(choice) for choice in action.choices)
    return action.dest.upper()


PAGES = {"site-file.md": site_page, "command-line.md": command_page}


def main() -> None:
    """Write the pages, or check them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--check", action="store_true", help="write nothing; fail when a page is stale")
    parser.add_argument("--folder", type=Path, default=DOCS, help="where the pages are")
    arguments = parser.parse_args()
    for name, write in PAGES.items():
        path, text = arguments.folder / name, write()
        if not arguments.check:
            path.write_text(text, encoding="utf-8")
        elif not path.is_file() or path.read_text(encoding="utf-8") != text:
            sys.exit(f"docs/{name} is not what the code gives; run 'make reference'")


if __name__ == "__main__":
    main()

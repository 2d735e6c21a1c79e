"""Every block of the documentation is run by a test, or says why not; those of data are valid."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any, cast

import jsonschema
import pytest

from rayfix_offline.site import parse_site
from rayfix_service.adapters.formats import InputFormat, parse
from rayfix_service.wire import parse_report
from tests.support.checkout import ROOT
from tests.support.doc_blocks import PAGES, Block, blocks_of

RUN = {"sh", "python", "json", "toml"}
"""Languages that tests run or validate. ``text`` is what programs print, drawings and formulas."""

COMMAND = re.compile(r"(rayfix|python|pip|make|curl|docker|kubectl|helm) \S")
MESSAGES = {"nrppa": "NrppaDocument", "silabs": "SilabsDocument"}
ANSWERS = {"3gpp": "Local3dPointUncertaintyEllipsoid", "omlox": "OmloxLocation"}
AOA = {"type": "aoa", "station_id": "bs1", "azimuth_deg": 41.2, "azimuth_stdev_deg": 2.0}

BLOCKS = [block for page in PAGES for block in blocks_of(page)]
OPENAPI = json.loads((ROOT / "docs" / "openapi.json").read_text(encoding="utf-8"))


def of(*languages: str) -> list[Any]:
    """Blocks that are validated here, for parametrize."""
    found = [block for block in BLOCKS if block.language in languages and block.reason is None]
    assert found
    return [pytest.param(block, id=str(block)) for block in found]


def check_schema(document: Any, name: str) -> None:
    """Hold a document to a schema of the service's description."""
    schema = {"$ref": f"#/components/schemas/{name}", "components": OPENAPI["components"]}
    jsonschema.Draft202012Validator(schema).validate(document)


@pytest.mark.parametrize("block", [pytest.param(block, id=str(block)) for block in BLOCKS])
def test_a_block_is_run_or_says_why_not(block: Block):
    if block.reason is not None:
        assert len(block.reason) > 10
        assert block.language not in {"", "text"}, f"{block}: text is not run anyway"
    elif block.language == "text":
        assert not COMMAND.match(block.text), f"{block}: write sh for a command"
    else:
        assert block.language in RUN, f"{block}: write <!-- not run: why --> before it, or a language of {sorted(RUN)}"


@pytest.mark.parametrize(
    ("text", "problem"),
    [("Run:\n\n    rayfix demo\n", "3: write code between fences"), ("```sh\nrayfix demo\n", "1: .* not closed")],
)
def test_no_block_escapes(text: str, problem: str):
    with pytest.raises(ValueError, match=problem):
        blocks_of(Path("page.md"), text)


def test_a_mark_counts_directly_before_its_block():
    near, far = blocks_of(
        Path("page.md"), "<!-- not run: why -->\n```sh\na\n```\n\n<!-- not run: why -->\n\n```sh\nb\n```\n"
    )
    assert (near.reason, far.reason) == ("why", None)


def json_documents(text: str) -> list[Any]:
    """Documents of a block: one, one on each line, or keys that stand within a measurement."""
    try:
        return [json.loads(text)]
    except json.JSONDecodeError:
        if text.startswith('"'):
            return [AOA | json.loads(f"{{{text}}}")]
        return [json.loads(line) for line in text.splitlines()]


@pytest.mark.parametrize("block", of("json"))
def test_json_is_what_the_service_reads_or_writes(block: Block):
    for document in json_documents(block.text):
        if name := block.words.get("input"):
            check_schema(document, MESSAGES[name])
            assert parse(block.text.encode(), cast("InputFormat", name))
        elif name := block.words.get("schema") or ANSWERS.get(block.words.get("output", "")):
            check_schema(document, name)
        else:
            report = document if "measurements" in document else {"measurements": [document]}
            check_schema(report, "ReportDocument")
            assert parse_report(report).measurements


@pytest.mark.parametrize("block", of("toml"))
def test_toml_is_of_a_site_file(block: Block):
    parse_site({"site": {"name": "hall", "scene": "hall.glb"}} | tomllib.loads(block.text), source=str(block))

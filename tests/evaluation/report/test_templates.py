"""Templates of the report's page."""

from importlib.resources import files
from types import SimpleNamespace

import pytest
from jinja2 import UndefinedError

from rayfix_evaluation.report.page import _environment
from rayfix_evaluation.studies.methods import METHODS

STATEMENT = {
    "holds": False,
    "method": "rayfix",
    "claim": "Times <b>help</b> & angles, too.",
    "figures": "1 < 2",
    "reason": "<script>alert(1)</script>",
}


def test_all_templates_compile() -> None:
    environment = _environment()
    names = environment.list_templates()
    assert {"page.html", "macros.html", "head.html", "made.html"} <= set(names)
    for name in names:
        environment.get_template(name)


def test_what_is_put_into_the_page_is_escaped() -> None:
    page = _environment().get_template("statements.html").render(results={"statements": [STATEMENT]}, methods=METHODS)
    assert "Times &lt;b&gt;help&lt;/b&gt; &amp; angles, too." in page
    assert "<script" not in page
    assert "does not hold" in page


def test_a_misspelt_name_is_an_error_and_not_an_empty_place() -> None:
    with pytest.raises(UndefinedError):
        _environment().get_template("made.html").render(m=SimpleNamespace(), command="rayfix evaluate")


def test_templates_are_in_the_package() -> None:
    folder = files("rayfix_evaluation.report").joinpath("templates")
    assert sorted(p.name for p in folder.iterdir()) == sorted(_environment().list_templates())

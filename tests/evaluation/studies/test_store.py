"""What an evaluation's kept results belong to."""

from rayfix_evaluation.studies.store import code_digest, meaning

CODE = """
def half(x):
    return x / 2
"""


def test_comments_docstrings_and_layout_change_no_results() -> None:
    told = (
        '"""Numbers."""\nLIMIT = 3\n"""Most of them."""\ndef half(x):\n    """Halve."""\n    # Exactly.\n    return x/2'
    )
    assert meaning(told) == meaning("LIMIT = 3" + CODE)


def test_a_changed_number_or_name_changes_them() -> None:
    assert len({meaning(CODE), meaning(CODE.replace("2", "3")), meaning(CODE.replace("half", "part"))}) == 3


def test_the_digest_names_the_code() -> None:
    assert len(code_digest()) == 16
    assert int(code_digest(), 16) > 0

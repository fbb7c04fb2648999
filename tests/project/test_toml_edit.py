"""Setting keys of a TOML text leaves everything else unchanged."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatgraft.project.project_file import TEMPLATE
from splatgraft.project.toml_edit import with_keys

TEXT = """\
# a comment
[source]
capture = "a"  # beside

[segment]
box = [
  1, 2, 3,  # three
  4, 5, 6,
]
threshold = 0.5

# about the next table
[compose]
scale = 1.0
"""
VALUES = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(st.characters(codec="utf-8", exclude_characters="\x7f")),
    st.booleans(),
    st.lists(st.integers()),
)


def test_a_multi_line_value_is_replaced_and_comments_stay() -> None:
    found = with_keys(TEXT, "segment", {"box": (0.0, 1.5), "keep": "all", "threshold": None})
    assert tomllib.loads(found)["segment"] == {"box": [0.0, 1.5], "keep": "all"}
    for comment in ("# a comment", "# beside", "# about the next table\n[compose]"):
        assert comment in found


@given(
    st.dictionaries(st.sampled_from(["box", "keep", "threshold", "new"]), VALUES), st.sampled_from(["segment", "light"])
)
def test_set_values_are_read_back_and_others_stay(values: dict, table: str) -> None:
    before, after = tomllib.loads(TEXT), tomllib.loads(with_keys(TEXT, table, values))
    assert after.get(table, {}) == before.get(table, {}) | values
    assert {k: v for k, v in after.items() if k != table} == {k: v for k, v in before.items() if k != table}


def test_setting_and_removing_a_key_restores_the_values() -> None:
    text = TEMPLATE.replace("{source}", 'capture = "a"').replace("{target}", 'capture = "b"')
    changed = with_keys(with_keys(text, "relight", {"shade": 0.5}), "relight", {"shade": None})
    assert tomllib.loads(changed) == tomllib.loads(text) | {"relight": {}}
    assert with_keys(text, "relight", {"shade": None}) == text
    with pytest.raises(ValueError, match="by hand"):
        with_keys("segment = {box = [1]}\n", "segment", {"keep": "all"})

"""Properties of undo and redo."""

from hypothesis import given
from hypothesis import strategies as st

from splatgraft.editor.session.history import History


@given(st.lists(st.integers()))
def test_undoing_all_gives_the_first_value_and_redoing_all_the_last(values: list[int]) -> None:
    history = History(-1)
    for value in values:
        history = history.pushed(value)
    back = history
    for _ in values:
        back = back.undone()
    assert back.present == -1
    assert back.undone() == back
    for _ in values:
        back = back.redone()
    assert back == history
    assert back.redone() == back


@given(st.integers(), st.integers(), st.integers())
def test_a_new_step_discards_undone_values_and_an_amendment_adds_no_step(a: int, b: int, c: int) -> None:
    history = History(a).pushed(b).undone().pushed(c)
    assert history.redone() == history
    assert History(a).pushed(b).amended(c) == History(c, (a,))

"""Undo and redo as laws."""

from hypothesis import given
from hypothesis import strategies as st

from splatgraft.editor.session.history import History


@given(st.lists(st.integers()))
def test_undoing_all_gives_the_beginning_and_redoing_all_the_end(values: list[int]) -> None:
    history = History(-1)
    for value in values:
        history = history.then(value)
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
def test_a_new_step_forgets_what_was_undone_and_an_amendment_is_no_step(a: int, b: int, c: int) -> None:
    history = History(a).then(b).undone().then(c)
    assert history.redone() == history
    assert History(a).then(b).amended(c) == History(c, (a,))

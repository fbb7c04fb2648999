"""What the panel `Share` writes is what `export` writes, in a job of its own, and only that is served."""

from pathlib import Path

import pytest
from small_transfer import write_transfer
from waiting import wait_until

from splatgraft.cli import main
from splatgraft.commands.edit_project import FlowProject
from splatgraft.editor.jobs import exports
from splatgraft.editor.jobs.jobs import JobState
from splatgraft.editor.session.session import Session
from splatgraft.exports.export import EXPORT_SUFFIXES


@pytest.fixture
def session(tmp_path: Path) -> Session:
    root = write_transfer(tmp_path)
    (root / "project.toml").write_text('[source]\ncapture = "photos"\n[target]\ncapture = "photos"\n')
    return Session(FlowProject(root / "project.toml"))


def finished(session: Session) -> JobState:
    wait_until(lambda: (job := session.job()) is not None and not job.live, what="the end of the job")
    job = session.job()
    assert job is not None
    assert session.jobs._child is not None
    session.jobs._child.wait()
    return job


def test_each_format_of_export_can_be_shared() -> None:
    assert {kind.suffix for kind in exports.SHARE_KINDS.values()} == set(EXPORT_SUFFIXES)


def test_a_job_writes_what_the_command_writes(session: Session, tmp_path: Path) -> None:
    kind = exports.SHARE_KINDS["Scene, small (.sog)"]
    to = exports.export_path(session.files, kind, "object-with-shadow")
    assert to == session.files.root / "export" / "a_ball_on_a_plane_object_with_shadow.sog"
    session.export(to, page="viewer", layer="object-with-shadow", title="Write it")
    job = finished(session)
    assert job.outcome == "done", job.error
    assert main([*job.command[:3], str(tmp_path / "b.sog"), *job.command[4:]]) == 0
    assert to.read_bytes() == (tmp_path / "b.sog").read_bytes()
    assert job.command[4:] == ("--layer", "object-with-shadow")
    # what was assumed, then size and time
    assert "black over what lies behind" in job.said[0]
    assert job.said[-1].startswith(f"{to}: 0.0 MB in ")
    assert exports.written_exports(session.files) == (to,)


def test_what_cannot_be_written_is_the_error_of_the_job(session: Session) -> None:
    session.files.relit.parent.joinpath("is_object.npy").unlink()
    to = exports.export_path(session.files, exports.SHARE_KINDS["Scene, small (.sog)"], "object")
    session.export(to, page="viewer", layer="object", title="Write it")
    job = finished(session)
    assert job.outcome == "failed"
    assert "expected" in job.error
    assert job.said == ()
    assert not to.exists()


def test_missing_results_and_packages_are_said(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    report = exports.SHARE_KINDS["Report as one page (.html)"]
    with pytest.raises(ValueError, match="expected a report, found none yet"):
        exports.export_path(session.files, report, "all")
    session.files.result.unlink()
    page = exports.SHARE_KINDS["Page to look at (.html)"]
    # the light transfer alone can be shared before anything is consolidated
    assert exports.step_shown(session.files, is_report=False) == "relight"
    exports.export_path(session.files, page, "all")
    session.files.relit.unlink()
    with pytest.raises(ValueError, match="expected a finished scene, found none yet"):
        exports.export_path(session.files, page, "all")
    monkeypatch.setattr(exports, "find_spec", lambda name: None)
    assert "splatgraft[usd]" in (exports.missing_package(exports.SHARE_KINDS["Scene, OpenUSD (.usdz)"]) or "")
    assert exports.missing_package(page) is None


def test_only_shared_files_and_the_report_are_served(session: Session) -> None:
    root = session.files.root
    (root / "export").mkdir()
    session.files.report.mkdir()
    (session.files.report / "index.html").touch()
    for name in ("a.sog", ".a.partial.mp4"):
        (root / "export" / name).touch()
    (root / "export" / "out").symlink_to(root / "project.toml")
    assert exports.served_file(session.files, "export/a.sog") == root / "export" / "a.sog"
    assert exports.served_file(session.files, "index.html") == session.files.report / "index.html"
    for name in ("export/.a.partial.mp4", "export/../project.toml", "export/out", "../project.toml", "export/", ""):
        assert exports.served_file(session.files, name) is None

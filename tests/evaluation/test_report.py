"""The report works from its folder alone, names missing metrics, and escapes user text."""

import re
from html.parser import HTMLParser

import pytest
import torch
from PIL import Image

from splatgraft.evaluation.measure import ComparedView, Truth, measure
from splatgraft.evaluation.pictures import side_by_side, write_animation
from splatgraft.evaluation.report import Report, ReportView, StepTime, write_report


def pictures(seed=0):
    g = torch.Generator().manual_seed(seed)
    return {label: torch.rand(30, 40, 3, generator=g) for label in ("Copy-paste", "Result", "Ground truth")}


def example_views(count=3):
    return [ReportView(name=f"{i:04d}.png", held_out=i == 0, pictures=pictures(i)) for i in range(count)]


def example_metrics():
    p = pictures()
    truth = Truth(
        image=p["Ground truth"], background=p["Copy-paste"], mask=(torch.arange(40) > 20).float().repeat(30, 1)
    )
    view = ComparedView("a", False, p["Copy-paste"], p["Result"], p["Copy-paste"], truth)
    return measure([view])


class _Links(HTMLParser):
    void = frozenset({"meta", "img", "input", "link", "br"})

    def __init__(self):
        super().__init__()
        self.links, self.open = [], []

    def handle_starttag(self, tag, attrs):
        self.links += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_page_is_whole_and_self_contained(tmp_path):
    report = Report(
        title="A vase & a <room>",
        subtitle="One object.",
        metrics=example_metrics(),
        not_measured={"lpips": "no weights"},
        light="Red x1.2",
        steps=(StepTime("compose", 0.4), StepTime("consolidate", 75.2, "30 views")),
        limits=("Clipped light is guessed.",),
    )
    frames = list(pictures().values())
    page = write_report(tmp_path, report, views=iter(example_views()), geometry=example_views(2), turntable=frames)
    text = page.read_text()
    links = _Links()
    links.feed(text)
    assert links.open == []
    assert links.links
    for link in links.links:
        assert (tmp_path / link).is_file(), link
    assert not re.search(r"https?://", text)
    assert "A vase &amp; a &lt;room&gt;" in text
    assert "not measured: no weights" in text
    assert "1 min 15 s" in text
    assert len(list((tmp_path / "views").iterdir())) == 9
    assert len([link for link in links.links if link.startswith("geometry/")]) == 6


def test_without_truth_no_score_is_shown(tmp_path):
    report = Report(title="t", subtitle="s", changes={"object_brightness": 1.5, "darkened_fraction": 0.03})
    text = write_report(tmp_path, report, views=example_views(1)).read_text()
    assert "PSNR" not in text
    assert "without ground truth" in text
    assert "1.50 x" in text
    assert "Depth and normals" not in text
    assert not (tmp_path / "metrics.json").exists()


def test_a_name_cannot_end_the_script(tmp_path):
    views = [ReportView(name="</script><b>", held_out=False, pictures=pictures())]
    text = write_report(tmp_path, Report(title="t", subtitle="s"), views=views).read_text()
    assert text.count("</script>") == 2


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_animation_loops_and_fits(tmp_path, suffix):
    frames = [torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(i)) for i in range(6)]
    path = tmp_path / f"turn{suffix}"
    write_animation(path, frames, fps=10.0, max_bytes=20_000)
    assert path.stat().st_size <= 20_000
    with Image.open(path) as picture:
        assert picture.n_frames == 6
        assert picture.info["loop"] == 0
        picture.seek(1)
        picture.load()
        assert picture.info["duration"] == 100


def test_side_by_side_keeps_the_pictures():
    left, right = torch.full((120, 100, 3), 0.25), torch.full((120, 80, 3), 0.75)
    joined = side_by_side([left, right], ["Before", "After"])
    assert joined.shape[0] == 120
    assert joined.shape[1] == 100 + 80 + 2
    assert torch.allclose(joined[:60, :100], left[:60], atol=1 / 255)  # labels are below, pictures pass 8 bits
    assert torch.allclose(joined[:60, 102:], right[:60], atol=1 / 255)
    assert (joined[60:, :100] > 0.9).any()

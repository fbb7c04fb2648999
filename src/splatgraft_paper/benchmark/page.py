"""The HTML page of a benchmark: a slider between any two methods, and all tables; style as in report_page.py."""

from collections.abc import Sequence
from html import escape

from splatgraft.evaluation.report_page import ViewFiles, html_page, viewer
from splatgraft_paper.benchmark.table import Benchmark, Table, tables


def benchmark_html(benchmark: Benchmark, views: Sequence[ViewFiles]) -> str:
    """Format the page; the files of `views` are relative to it."""
    notes = [*benchmark.notes, *benchmark.not_run]
    notes += [f"Not measured: {name}: {reason}" for name, reason in benchmark.not_measured.items()]
    items = "".join(f"<li>{escape(note)}</li>" for note in notes)
    sections = [
        viewer(views) if views else "",
        *(table_section(table) for table in tables(benchmark)),
        f"<section><h2>Limitations</h2><ul>{items}</ul></section>\n",
    ]
    scenes = len(benchmark.scenes)
    count = f"{len(benchmark.methods)} methods on {scenes} scene{'s' if scenes != 1 else ''}"
    subtitle = f"{count}; means over held-out views, then over scenes, with 95% bootstrap intervals over scenes."
    return html_page("Benchmark of object transfer", subtitle, "".join(sections), views=views)


def table_section(table: Table) -> str:
    """Format one table with its title."""
    head = "".join(f'<th scope="col">{escape(cell)}</th>' for cell in table.head)
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th>' + "".join(f"<td>{escape(cell)}</td>" for cell in cells) + "</tr>"
        for name, *cells in table.rows
    )
    return (
        f'<section><h2>{escape(table.title)}</h2><div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div></section>\n"
    )

"""Style sheet of the page, where viser's own leaves too little room: the row of steps, and narrow windows."""

_CSS = """<style>
div:has(> * > label[for="{steps}"]) {{ display: none; }}
@media (max-width: 36em) {{
  div[style*="position: fixed"][style*="width: 20em"],
  div[style*="position: fixed"][style*="width: 20em"] div[style*="width: 20em"] {{ width: 100% !important; }}
  div[style*="position: fixed"][style*="width: 20em"] {{ max-height: 48% !important; }}
}}
</style>"""


def style_sheet(steps: str) -> str:
    """HTML of the style sheet.

    The label of the steps is hidden, so that five buttons fit in one row; in a window as narrow as a phone's the panel
    takes the whole width, so that numbers are legible, and less than half of the height, so that the middle of the
    scene is seen.

    Args:
        steps: Identifier of the group of buttons of the steps.
    """
    return _CSS.format(steps=steps)

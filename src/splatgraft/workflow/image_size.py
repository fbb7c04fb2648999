"""Image sizes as the command line writes them: WIDTHxHEIGHT."""


def parse_image_size(text: str, *, multiple_of: int = 1) -> tuple[int, int]:
    """Parse the value of --size.

    Args:
        text: Such as `704x496`.
        multiple_of: Both sides must be multiples of this, pixels.

    Returns:
        Width and height, pixels.

    Raises:
        ValueError: The text is not of this form.
    """
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) and int(part) % multiple_of == 0 for part in parts):
        wanted = "WIDTHxHEIGHT" if multiple_of == 1 else f"WIDTHxHEIGHT in multiples of {multiple_of}"
        raise ValueError(f"--size: expected {wanted}, found {text}")
    return int(parts[0]), int(parts[1])

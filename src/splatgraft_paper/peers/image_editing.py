"""Client of an image-editing service with the paper's prompt (Sec. 7), used only on request and up to a cost limit.

The protocol is Google's `generateContent`; the paper's Nano Banana is gemini-2.5-flash-image.
"""

import base64
import io
import json
import os
import urllib.error
import urllib.request
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from splatgraft.core.images import resize
from splatgraft.harmonization.image_editing import PROMPT
from splatgraft.harmonization.interface import Harmonizer, HarmonizerContext, HarmonizerInputs

KEY_VARIABLE = "SPLATGRAFT_IMAGE_EDITING_KEY"
DOLLARS_PER_VIEW = 0.04
"""Price of one image by gemini-2.5-flash-image at the time of writing; other services differ."""
_URL = "https://generativelanguage.googleapis.com/v1beta/models/gemini-2.5-flash-image:generateContent"
_TIMEOUT_SECONDS = 180


@dataclass(frozen=True)
class ImageEditingOptions:
    """An image-editing service over HTTP with the paper's prompt (Sec. 7); your pictures leave this machine."""

    name: ClassVar[str] = "image-editing"

    weights: str = _URL
    """Address of the service; default: the paper's."""
    max_cost: float = 0.0
    """Maximum cost, US dollars."""

    def make(self, context: HarmonizerContext) -> Harmonizer:
        """Print the cost and check the key, an environment variable because options are saved in step.json."""
        url = self.weights
        if not url.startswith(("https://", "http://127.0.0.1", "http://localhost")):
            raise ValueError(f"harmonizer image-editing: expected --weights https://..., found {url}")
        cost = context.views * DOLLARS_PER_VIEW
        context.say(f"image-editing: {context.views} views to {url}, about {cost:.2f} US dollars; they are uploaded")
        if cost > self.max_cost:
            raise ValueError(f"--max-cost: expected at least {cost:.2f} US dollars, found {self.max_cost:.2f}")
        if not (key := os.environ.get(KEY_VARIABLE)):
            raise ValueError(f"harmonizer image-editing: expected a key in {KEY_VARIABLE}, found none")
        return ImageEditing(url, key)


@dataclass(frozen=True)
class ImageEditing:
    """An image-editing service that gets one request per view."""

    url: str
    key: str

    def harmonize(self, view: HarmonizerInputs) -> Float[Tensor, "h w 3"]:
        """Send composite and mask to the service and resize the returned image to the view's size."""
        mask = (view.mask > 0.5).float()[..., None].expand(-1, -1, 3)
        pictures = [{"inline_data": {"mime_type": "image/png", "data": _png(one)}} for one in (view.composite, mask)]
        content = json.dumps({"contents": [{"parts": [{"text": PROMPT}, *pictures]}]}).encode()
        headers = {"Content-Type": "application/json", "x-goog-api-key": self.key}
        answer = ""
        try:
            request = urllib.request.Request(self.url, content, headers)
            with urllib.request.urlopen(request, timeout=_TIMEOUT_SECONDS) as response:
                answer = response.read().decode()
            parts = [part for one in json.loads(answer)["candidates"] for part in one["content"]["parts"]]
            made = next(part["inlineData"]["data"] for part in parts if "inlineData" in part)
            image = Image.open(io.BytesIO(base64.b64decode(made))).convert("RGB")
        except urllib.error.HTTPError as error:
            found = " ".join(error.read().decode(errors="replace").split())[:160]
            raise ValueError(f"{self.url}: expected an answer, found status {error.code}: {found}") from error
        except (OSError, ValueError, KeyError, TypeError, StopIteration) as error:
            found = " ".join(answer.split())[:160] or str(error)
            raise ValueError(f"{self.url}: expected a picture in the answer, found {found}") from error
        height, width = view.mask.shape
        return resize(torch.from_numpy(np.array(image)).float() / 255, width, height)


def _png(picture: Float[Tensor, "h w 3"]) -> str:
    content = io.BytesIO()
    Image.fromarray((picture * 255).round().to(torch.uint8).numpy()).save(content, "PNG")
    return base64.b64encode(content.getvalue()).decode()

"""Figures as short text for a page: JSON, and beside it their numbers, each array once, compressed.

plotly.js takes arrays as `{"dtype": ..., "bdata": base64}`. Here each of these becomes `{"array": i}`, and the i-th
array stands among all others in one text, its bytes sorted by their place in a number: the high ones, which hardly
change, compress to next to nothing.
"""

from __future__ import annotations

import base64
import json
import zlib
from typing import Any

import numpy as np

_SIZES = {"f4": 4, "f8": 8}
"""Bytes of a number."""


def packed_text(text: str) -> str:
    """A text compressed (zlib), in base64: a browser unpacks it by itself."""
    return _packed(text.encode("utf-8"))


def packed_figures(content: Any) -> dict[str, str]:
    """Dictionaries and lists with plotly's arrays in them: `json` without these, `arrays` the numbers of all of them.

    Equal arrays are there once, as the time of lines over time.
    """
    arrays: dict[tuple[str, str], int] = {}
    tree = _without_arrays(content, arrays)
    sizes = [(dtype, len(base64.b64decode(bdata))) for dtype, bdata in arrays]
    text = json.dumps({"content": tree, "sizes": sizes}, allow_nan=False, separators=(",", ":"))
    blob = b"".join(_sorted_by_place(base64.b64decode(bdata), _SIZES[dtype]) for dtype, bdata in arrays)
    return {"json": packed_text(text), "arrays": _packed(blob)}


def _packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode("ascii")


def _without_arrays(content: Any, arrays: dict[tuple[str, str], int]) -> Any:
    if isinstance(content, dict):
        if "bdata" in content:
            return {"array": arrays.setdefault((content["dtype"], content["bdata"]), len(arrays))}
        return {key: _without_arrays(value, arrays) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_without_arrays(value, arrays) for value in content]
    return content


def _sorted_by_place(data: bytes, size: int) -> bytes:
    """First the first byte of each number, then the second of each, and so on."""
    return bytes(np.frombuffer(data, dtype=np.uint8).reshape(-1, size).T.tobytes())

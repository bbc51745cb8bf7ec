"""The seed papers' numbers, evaluated independently of this project in rational or 64-bit arithmetic."""

import json
from pathlib import Path
from typing import Any


def load() -> dict[str, Any]:
    """All vectors by name; angles in degrees."""
    got: dict[str, Any] = json.loads((Path(__file__).parent / "authorities" / "seed-vectors.json").read_text())
    return got

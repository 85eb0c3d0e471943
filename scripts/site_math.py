"""A hook of mkdocs: blocks of ```math become MathML, which browsers show without any script."""

from typing import Any

from latex2mathml.converter import convert


def on_config(config: Any) -> Any:
    """Add the format of such blocks to those of pymdownx.superfences."""
    fences = config.mdx_configs.setdefault("pymdownx.superfences", {}).setdefault("custom_fences", [])
    fences.append({"name": "math", "class": "math", "format": _formatted})
    return config


def _formatted(source: str, *_: object, **__: object) -> str:
    return f'<div class="math">{convert(source, display="block")}</div>'

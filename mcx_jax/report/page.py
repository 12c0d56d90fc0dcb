"""The HTML page: one file, pictures and style inside, nothing fetched."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from mcx_jax.report.sections import Section

STYLE = Path(__file__).with_name("page.css")
CODE = ("command", "task", "motion")
"""Facts that are code."""


def page(
    title: str,
    subtitle: str,
    lead: Sequence[str],
    sections: Sequence[Section],
    pngs: Mapping[str, bytes],
    facts: Mapping[str, str],
) -> str:
    """The page as text.

    Args:
        lead: sentences that say the result.
        pngs: of every panel of the sections, by name.
        facts: how the numbers were made.
    """
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE.read_text(encoding='utf-8')}</style></head>"
    )
    body = [f'<header><h1>{escape(title)}</h1><p class="sub">{escape(subtitle)}</p>']
    if lead:
        sentences = "".join(f"<p>{escape(sentence)}</p>" for sentence in lead)
        body.append(f'<div class="lead">{sentences}</div>')
    body.append("</header><main>")
    body += [_section(section, pngs) for section in sections]
    items = "".join(f"<dt>{escape(k)}</dt><dd>{_value(k, v)}</dd>" for k, v in facts.items())
    body.append(f"<section><h2>How it was made</h2><dl>{items}</dl></section></main>")
    return f"{head}\n<body>{chr(10).join(body)}</body></html>\n"


def _section(section: Section, pngs: Mapping[str, bytes]) -> str:
    images = "".join(
        f'<img alt="{escape(panel.alt)}" src="data:image/png;base64,'
        f'{base64.b64encode(pngs[panel.name]).decode()}">'
        for panel in section.panels
    )
    panels = f'<div class="panels">{images}</div>' if images else ""
    return (
        f"<section><h2>{escape(section.title)}</h2><figure>{section.table}{panels}"
        f"<figcaption>{escape(section.caption)}</figcaption></figure></section>"
    )


def _value(name: str, text: str) -> str:
    return f"<code>{escape(text)}</code>" if name in CODE else escape(text)

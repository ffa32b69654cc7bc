"""The report's page: its style sheet and small pieces of HTML. No script, no font, nothing to load."""

from collections.abc import Iterable, Mapping
from html import escape

STYLE = """
:root { --ink:#1d2228; --soft:#5d6570; --line:#e0e4e9; --paper:#ffffff; --wash:#f5f7f9; --accent:#0b6e99;
  --bad:#a33a12; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin:0; background:var(--wash); color:var(--ink); font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,
  "Helvetica Neue",Arial,sans-serif; }
main { max-width:1120px; margin:0 auto; padding:24px 20px 64px; }
header h1 { font-size:2rem; line-height:1.2; margin:.2em 0 .1em; letter-spacing:-.01em; }
header p { color:var(--soft); margin:.2em 0 1em; max-width:70ch; }
section { background:var(--paper); border:1px solid var(--line); border-radius:10px; padding:20px 24px; margin:18px 0; }
h2 { font-size:1.3rem; margin:.1em 0 .4em; }
h3 { font-size:1.02rem; margin:1.4em 0 .4em; }
h2 + h3 { margin-top:.4em; }
p, li { max-width:80ch; }
.note { color:var(--soft); font-size:.9rem; }
.facts { display:grid; grid-template-columns:repeat(auto-fit,minmax(190px,1fr)); gap:12px 20px; margin:0; }
.facts div { min-width:0; border-left:3px solid var(--line); padding-left:10px; }
.facts dt { color:var(--soft); font-size:.8rem; }
.facts dd { margin:0; overflow-wrap:anywhere; }
.scroll { overflow-x:auto; }
table { border-collapse:collapse; width:100%; font-variant-numeric:tabular-nums; font-size:.92rem; }
th, td { padding:6px 10px; border-bottom:1px solid var(--line); text-align:right; vertical-align:top;
  white-space:nowrap; }
th:first-child, td:first-child { text-align:left; white-space:normal; min-width:11em; }
thead th { border-bottom:2px solid #b9c0c8; font-weight:600; }
tbody th { font-weight:400; }
td .range { display:block; color:var(--soft); font-size:.76rem; }
td.best { background:#e4f2f7; font-weight:700; }
td.best .range { font-weight:400; }
td.ceiling, th.ceiling { color:var(--soft); font-style:italic; }
.unit { color:var(--soft); font-size:.85em; }
.lost { color:var(--bad); }
.grid { display:grid; gap:16px 18px; grid-template-columns:repeat(auto-fit,minmax(min(100%,300px),1fr)); }
.pairs { display:grid; gap:16px 18px; grid-template-columns:repeat(auto-fit,minmax(min(100%,480px),1fr)); }
.pair { display:grid; grid-template-columns:1fr 1fr; gap:4px; margin:0; }
.pair figcaption { grid-column:1/-1; }
figure { margin:0; min-width:0; }
figure > img, figure > svg { width:100%; height:auto; display:block; }
figcaption { font-size:.9rem; margin:2px 0 4px; }
img { max-width:100%; height:auto; display:block; }
.wide img { margin:0 auto; }
.map img { max-width:min(100%,800px); }
svg image { image-rendering:pixelated; }
svg text { font:12.5px system-ui,-apple-system,"Segoe UI",Roboto,Arial,sans-serif; fill:#3a414a; }
svg .frame { fill:none; stroke:#5d6570; stroke-width:1; }
svg .tick { stroke:#5d6570; stroke-width:1; fill:none; }
svg .mark { fill:none; stroke:#fff; stroke-width:1.8; }
svg .mark-under { fill:none; stroke:#111; stroke-width:4; }
svg.bar { width:100%; max-width:460px; height:auto; display:block; }
.bars { display:flex; flex-wrap:wrap; gap:4px 24px; margin:8px 0 0; }
.scales { display:flex; flex-direction:column; justify-content:center; gap:18px; }
.bars > * { flex:1 1 260px; }
.time { display:block; margin-top:8px; height:9px; background:var(--accent); border-radius:2px; min-width:2px; }
pre { background:var(--wash); border:1px solid var(--line); border-radius:6px; padding:10px 12px; overflow-x:auto;
  font:13.5px/1.45 ui-monospace,"SF Mono",Menlo,Consolas,monospace; white-space:pre-wrap; overflow-wrap:anywhere; }
details { margin-top:14px; } summary { cursor:pointer; color:var(--accent); }
details dt { font-weight:600; margin-top:6px; } details dd { margin:0; color:var(--soft); }
@media (max-width:600px) { main { padding:12px 10px 40px; } section { padding:14px 13px; border-radius:8px; }
  header h1 { font-size:1.5rem; } th, td { padding:5px 6px; } th:first-child, td:first-child { min-width:7.5em; }
  .word { display:none; } }
@media print { body { background:#fff; font-size:10.5pt; } main { max-width:none; padding:0; }
  section { border:0; padding:0; margin:0 0 18px; } figure, tr { break-inside:avoid; } h2, h3 { break-after:avoid; }
  .scroll { overflow:visible; } td.best, .time { print-color-adjust:exact; -webkit-print-color-adjust:exact; }
  .grid { grid-template-columns:1fr 1fr; } }
"""


def page(title: str, lead: str, sections: Iterable[str]) -> str:
    """The whole document; the policy in its head forbids loading anything."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><main>"
        f"<header><h1>{escape(title)}</h1><p>{escape(lead)}</p></header>\n"
        + "\n".join(sections)
        + "\n</main></body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """A titled block; nothing when it would be empty."""
    body = "".join(parts)
    return f"<section><h2>{escape(title)}</h2>{body}</section>" if body else ""


def facts(pairs: Mapping[str, object]) -> str:
    """Names and values side by side."""
    items = "".join(f"<div><dt>{escape(str(k))}</dt><dd>{escape(str(v))}</dd></div>" for k, v in pairs.items())
    return f'<dl class="facts">{items}</dl>' if items else ""


def figure(content: str, caption: str, *, kind: str = "") -> str:
    """A picture with its caption above it."""
    return f'<figure class="{kind}"><figcaption>{escape(caption)}</figcaption>{content}</figure>'


def image(address: str, alternative: str) -> str:
    """A picture from a data address."""
    return f'<img src="{address}" alt="{escape(alternative, quote=True)}">'


def note(text: str) -> str:
    """A paragraph in small grey type."""
    return f'<p class="note">{escape(text)}</p>'

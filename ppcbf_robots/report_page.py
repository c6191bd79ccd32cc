"""The HTML of a report: one file without scripts from elsewhere, for light and dark screens, readable aloud."""

from __future__ import annotations

import base64
import gzip
from dataclasses import dataclass, field
from typing import Any, Literal

from jinja2 import Environment, StrictUndefined

Tone = Literal["good", "warn", "bad", "none"]


@dataclass(frozen=True)
class Badge:
    """One of the statements at the top."""

    title: str
    word: str
    detail: str
    tone: Tone  # never alone: the word says the same


@dataclass(frozen=True)
class Figure:
    """A picture with what it shows in words, for those who do not see it."""

    svg: bytes
    alt: str
    caption: str

    @property
    def data(self) -> str:
        """As the address of an image."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg).decode()


@dataclass(frozen=True)
class Table:
    """Columns and rows of text; the first column names the row."""

    caption: str
    columns: list[str]
    rows: list[list[str]]


@dataclass(frozen=True)
class Section:
    """A part of the report, in the order text, tables, figures, notes with their heading."""

    name: str  # of its anchor
    title: str
    text: list[str] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    noted: str = "Notes"


def render_report(
    title: str, subtitle: str, badges: list[Badge], sections: list[Section], view: str, footer: str
) -> str:
    """The page.

    Args:
        title: heading.
        subtitle: what the report is about, in a line.
        badges: statements at the top.
        sections: parts in their order.
        view: a whole HTML page of its own, shown in a frame; stored compressed.
        footer: how the report was made.
    """
    packed = base64.b64encode(gzip.compress(view.encode(), compresslevel=9, mtime=0)).decode()
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    context: dict[str, Any] = {"title": title, "subtitle": subtitle, "badges": badges, "sections": sections,
                               "view": packed, "footer": footer}  # fmt: skip
    return environment.from_string(_PAGE).render(context)


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{{ title }}</title><link rel="icon" href="data:,">
<style>
:root { --ink: #1c2430; --soft: #5a6675; --line: #d9dee5; --ground: #f6f7f9; --card: #fff; --link: #1a5fb4;
  --good: #1d6b3a; --good-bg: #e3f4e8; --warn: #7a5200; --warn-bg: #fdf1d6; --bad: #a3111f; --bad-bg: #fde5e6; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaf0; --soft: #a3adba; --line: #36404d; --ground: #14181e;
  --card: #1d232b; --link: #86b7f5; --good: #8fdba9; --good-bg: #15331f; --warn: #f2c66d; --warn-bg: #3a2c0c;
  --bad: #ff9aa2; --bad-bg: #43161b; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink); font: 16px/1.55 system-ui, sans-serif; }
a { color: var(--link); }
header, main, footer { max-width: 1020px; margin: 0 auto; padding: 0 20px; }
header { padding-top: 32px; }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 4px; }
h2 { font-size: 21px; margin: 0 0 10px; }
h3 { font-size: 16px; margin: 14px 0 0; }
.soft, figcaption, footer, caption { color: var(--soft); }
nav ul { list-style: none; margin: 16px 0; padding: 0; display: flex; flex-wrap: wrap; gap: 4px 18px; }
.skip { position: absolute; left: -999px; } .skip:focus { left: 20px; top: 8px; }
.badges { display: grid; grid-template-columns: repeat(auto-fit, minmax(175px, 1fr)); gap: 12px; padding: 0;
  margin: 20px 0; list-style: none; }
.badges li, section { background: var(--card); border: 1px solid var(--line); border-radius: 10px; }
.badges li { padding: 12px 14px; }
.badges .what { font-size: 13px; color: var(--soft); }
.badges .detail { font-size: 13px; }
.word { display: inline-block; font-weight: 650; font-size: 17px; border-radius: 6px; padding: 1px 8px; margin: 3px 0; }
.good { color: var(--good); background: var(--good-bg); } .warn { color: var(--warn); background: var(--warn-bg); }
.bad { color: var(--bad); background: var(--bad-bg); } .none { border: 1px solid var(--line); }
section { padding: 20px 22px; margin: 18px 0; }
.wide { overflow-x: auto; margin: 12px 0; }
table { border-collapse: collapse; font-size: 14.5px; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-size: 14px; padding-bottom: 4px; }
th, td { text-align: left; vertical-align: top; padding: 5px 18px 5px 0; border-bottom: 1px solid var(--line); }
thead th { color: var(--soft); font-weight: 600; }
tbody th { font-weight: 500; }
.many { min-width: 620px; }
figure { margin: 16px 0; }
figure img { width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 8px; }
figcaption { font-size: 14px; }
iframe { width: 100%; height: 560px; border: 1px solid var(--line); border-radius: 8px; background: #fff; }
footer { font-size: 14px; padding-bottom: 40px; }
@media print { nav, #view { display: none; } section { break-inside: avoid; } }
</style>
</head>
<body>
<a class="skip" href="#content">To the content</a>
<header>
<h1>{{ title }}</h1>
<p class="soft">{{ subtitle }}</p>
<ul class="badges" aria-label="Summary">
{% for badge in badges %}
<li><div class="what">{{ badge.title }}</div><div class="word {{ badge.tone }}">{{ badge.word }}</div>
<div class="detail">{{ badge.detail }}</div></li>
{% endfor %}
</ul>
<nav aria-label="Sections"><ul>
{% for section in sections %}
<li><a href="#{{ section.name }}">{{ section.title }}</a></li>
{% endfor %}
<li><a href="#view">3-D view</a></li>
</ul></nav>
</header>
<main id="content">
{% for section in sections %}
<section id="{{ section.name }}" aria-labelledby="{{ section.name }}-title">
<h2 id="{{ section.name }}-title">{{ section.title }}</h2>
{% for line in section.text %}
<p>{{ line }}</p>
{% endfor %}
{% for table in section.tables %}
<div class="wide" tabindex="0" role="region" aria-label="{{ table.caption }}">
<table{% if table.columns|length > 3 %} class="many"{% endif %}>
<caption>{{ table.caption }}</caption>
{% if table.columns %}
<thead><tr>{% for column in table.columns %}<th scope="col">{{ column }}</th>{% endfor %}</tr></thead>
{% endif %}
<tbody>
{% for row in table.rows %}
<tr><th scope="row">{{ row[0] }}</th>{% for cell in row[1:] %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}
</tbody></table></div>
{% endfor %}
{% for figure in section.figures %}
<figure><img src="{{ figure.data }}" alt="{{ figure.alt }}" loading="lazy">
<figcaption>{{ figure.caption }}</figcaption></figure>
{% endfor %}
{% if section.notes %}
<h3>{{ section.noted }}</h3>
<ul class="soft">{% for note in section.notes %}<li>{{ note }}</li>{% endfor %}</ul>
{% endif %}
</section>
{% endfor %}
<section id="view" aria-labelledby="view-title">
<h2 id="view-title">3-D view</h2>
<p>The run of this report, to be played and turned. The path is coloured by what the filter does.</p>
<iframe id="frame" title="The run in 3-D: a moving robot among its obstacles, with a time slider"></iframe>
<noscript><p>The view needs JavaScript.</p></noscript>
</section>
</main>
<footer><p>{{ footer }}</p></footer>
<script type="text/plain" id="packed">{{ view }}</script>
<script>
async function show() {
  const bytes = Uint8Array.from(atob(document.getElementById("packed").textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  document.getElementById("frame").srcdoc = await new Response(stream).text();
}
new IntersectionObserver((entries, watcher) => {  // a page that is only read draws nothing in 3-D
  if (entries.some((entry) => entry.isIntersecting)) { watcher.disconnect(); show(); }
}, {rootMargin: "200px"}).observe(document.getElementById("frame"));
document.body.dataset.ready = "yes";
</script>
</body>
</html>
"""

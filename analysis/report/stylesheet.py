"""The page's style: dark on white, prints on A4 and Letter alike, nothing from elsewhere."""

from __future__ import annotations

STYLESHEET = """
:root { --ink: #1b1b1b; --quiet: #555; --line: #c9c9c9; --soft: #f4f4f1; --alarm: #a11b00; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem; max-width: 62rem; color: var(--ink); background: #fff;
  font: 15px/1.45 "DejaVu Sans", "Segoe UI", Roboto, Helvetica, Arial, sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .2rem; }
h2 { font-size: 1.2rem; margin: 2rem 0 .5rem; padding-top: .5rem;
  border-top: 2px solid var(--ink); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
p { margin: .4rem 0; }
.quiet, figcaption, td small, caption { color: var(--quiet); }
.verdict { font-size: 1.2rem; font-weight: 600; margin: .8rem 0; }
.mark { margin: 1rem 0; padding: .8rem 1rem; border: 4px solid var(--alarm);
  color: var(--alarm); font-size: 1.8rem; font-weight: 700; text-align: center; }
ul.warnings { list-style: none; margin: 1rem 0; padding: 0; }
ul.warnings li { margin: .3rem 0; padding: .4rem .7rem; border-left: 5px solid var(--line);
  background: var(--soft); overflow-wrap: anywhere; }
ul.warnings li.warning { border-color: var(--alarm); }
dl.head { display: grid; grid-template-columns: max-content 1fr; gap: .15rem 1.2rem; margin: 0; }
dl.head dt { color: var(--quiet); }
dl.head dd { margin: 0; overflow-wrap: anywhere; }
.tiles { display: flex; flex-wrap: wrap; gap: .6rem; margin: 1rem 0; }
.tile { flex: 1 1 6.6rem; border: 1px solid var(--line); padding: .5rem .7rem; }
.tile b { display: block; font-size: 1.35rem; }
.tile span { color: var(--quiet); font-size: .85rem; }
figure { margin: 1rem 0; break-inside: avoid; }
figure img, figure svg { display: block; width: 100%; height: auto; }
figcaption { font-size: .85rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: .5rem 0 1rem; font-size: .9rem; }
caption { text-align: left; padding-bottom: .2rem; }
th, td { padding: .22rem .6rem .22rem 0; text-align: left; vertical-align: top;
  border-bottom: 1px solid var(--line); overflow-wrap: break-word; }
table.record { table-layout: fixed; }
table.record td { overflow-wrap: anywhere; }
td.k { white-space: nowrap; }
th { font-weight: 600; border-bottom: 1.5px solid var(--ink); }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
tr.missing td { color: var(--alarm); font-weight: 600; }
.incomplete { color: var(--alarm); font-weight: 700; }
pre { white-space: pre-wrap; overflow-wrap: anywhere; background: var(--soft); padding: .7rem;
  font-size: .78rem; }
code { overflow-wrap: anywhere; }
@page { margin: 15mm; }
@media print {
  body { max-width: none; padding: 0; font-size: 10pt; }
  h2 { break-after: avoid; }
  h3, caption { break-after: avoid; }
  table { font-size: 8.5pt; }
  .verdict { font-size: 12pt; }
  .tiles { gap: .3rem; }
  .tile { padding: .4rem .45rem; }
  tr, .tile, ul.warnings li { break-inside: avoid; }
  /* Two maps on a page: of tall fields one would fill more than half of it. */
  figure img { max-height: 88mm; max-width: 100%; width: auto !important; }
  thead { display: table-header-group; }
  details { display: none; }
}
"""

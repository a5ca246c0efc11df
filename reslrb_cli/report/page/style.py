"""How the page looks: on a phone and on a wide screen, in light and dark, and on paper."""

from __future__ import annotations

#: A table on a screen that is too narrow for its columns: each row is a block, with a line for each column.
_BLOCKS = """
  .rows, .rows tbody, .rows tr, .rows th, .rows td { display: block; border: 0; padding: 0 }
  .rows thead { display: none }
  .rows tr { border-bottom: 1px solid var(--line); padding: .55rem 0 }
  .rows td { display: grid; grid-template-columns: 7.5rem minmax(0, 1fr); gap: .6rem; padding: .08rem 0 }
  .rows td::before { content: attr(data-label); color: var(--soft); font-size: .85rem }
  .rows td:empty { display: none }
"""
_STYLE = """
:root {
  color-scheme: light dark;
  --page: #fff; --ink: #1c1f23; --soft: #5d6570; --line: #dde1e6; --box: #f5f6f8; --edge: #c9ced6;
  --good: #17703a; --warn: #8a4b00; --warn-box: #fff4e0; --bad: #a3141f; --bad-box: #fdecec; --link: #2458c5;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #15181c; --ink: #e6e8eb; --soft: #a0a8b3; --line: #2d333b; --box: #1d2127; --edge: #444c56;
    --good: #5fd38d; --warn: #ffc368; --warn-box: #33260f; --bad: #ff8f8f; --bad-box: #3a1a1c; --link: #8ab4ff;
  }
}
* { box-sizing: border-box }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100% }
body {
  margin: 0 auto; padding: 1.5rem clamp(.9rem, 3vw, 2.5rem) 3rem; max-width: 78rem;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", "DejaVu Sans", sans-serif;
  color: var(--ink); background: var(--page); overflow-wrap: anywhere;
}
h1 { font-size: 1.65rem; line-height: 1.2; margin: 0 }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .7rem; padding-bottom: .25rem; border-bottom: 1px solid var(--line) }
h3 { font-size: 1rem; margin: 1.4rem 0 .5rem; font-weight: 600 }
p { margin: .4rem 0; max-width: 60rem }
code, pre { font-family: ui-monospace, "SF Mono", Menlo, Consolas, "Liberation Mono", "DejaVu Sans Mono", monospace }
code { font-size: .9em }
pre {
  font-size: .82rem; line-height: 1.45; background: var(--box); padding: .9rem 1rem; border-radius: .5rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere;
}
.soft { color: var(--soft) } .small { font-size: .875rem } .worse { color: var(--bad); font-weight: 600 }
header { display: flex; flex-wrap: wrap; gap: .4rem .8rem; align-items: baseline }
.status {
  font-size: .85rem; font-weight: 600; padding: .1rem .65rem; border: 1px solid currentColor; border-radius: 1rem;
}
.status.finished { color: var(--good) } .status.failed { color: var(--bad) } .status { color: var(--warn) }
.lead { font-size: 1.05rem }
.note {
  border-left: 4px solid var(--warn); background: var(--warn-box); padding: .5rem .9rem; border-radius: .3rem;
  margin: .8rem 0;
}
.note.failed { border-color: var(--bad); background: var(--bad-box) }
.note p { margin: .15rem 0 }

table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .925rem; max-width: 100% }
th, td { text-align: left; vertical-align: top; padding: .32rem 1.4rem .32rem 0; border-bottom: 1px solid var(--line) }
thead th { color: var(--soft); font-weight: 500; font-size: .85rem }
tbody th { font-weight: 500 }
.rows td, thead th { overflow-wrap: break-word }
.facts th { color: var(--soft); font-weight: 500; white-space: nowrap; overflow-wrap: normal }
.facts td { overflow-wrap: anywhere }
.number { white-space: nowrap }
.dense { font-size: .85rem } .dense th, .dense td { padding-right: .8rem }
.swatch {
  display: inline-block; width: 1.05em; height: 1.05em; border: 1px solid var(--edge); border-radius: .2em;
  vertical-align: -.17em; margin-right: .45em; print-color-adjust: exact; -webkit-print-color-adjust: exact;
}
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(13rem, 1fr)); gap: 1rem 1.1rem }
figure { margin: 0; min-width: 0; break-inside: avoid }
figure img {
  display: block; width: 100%; height: auto; border: 1px solid var(--line); background: #000; border-radius: .25rem;
}
.pixels { image-rendering: pixelated }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .3rem }
figcaption b { color: var(--ink); font-weight: 600 }
.scale { height: .6rem; border-radius: .15rem; margin-top: .35rem; print-color-adjust: exact;
  -webkit-print-color-adjust: exact }
.ends { display: flex; justify-content: space-between }

.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 22rem), 1fr)); gap: .4rem 1.5rem }
.curves > * { max-width: 40rem }
.curves svg { display: block; width: 100%; height: auto }
.curves text { font-family: inherit }
.legend { list-style: none; display: flex; flex-wrap: wrap; gap: .15rem 1.2rem; margin: .2rem 0 .8rem; padding: 0;
  font-size: .875rem }
.mark { display: inline-block; width: 1.4em; height: 0; border-top: 3px solid; vertical-align: .25em;
  margin-right: .45em; print-color-adjust: exact; -webkit-print-color-adjust: exact }
.bars { list-style: none; padding: 0; margin: 0 0 .6rem }
.bar { display: flex; height: 1.1rem; margin: .1rem 0 .5rem; background: var(--box) }
.bar i { display: block; print-color-adjust: exact; -webkit-print-color-adjust: exact }
details { margin: .7rem 0 }
summary { cursor: pointer; font-weight: 600 }
summary + * { margin-top: .5rem }
footer { margin-top: 2.5rem; color: var(--soft); font-size: .85rem }

@media (max-width: 68rem) {
  @DENSE@
}
@media (max-width: 46rem) {
  .figures { grid-template-columns: repeat(2, minmax(0, 1fr)); gap: .8rem }
  @BLOCKS@
  .facts th { white-space: normal; padding-right: .9rem }
  .facts td { padding-right: 0 }
}
@media print {
  :root { --page: #fff; --ink: #000; --soft: #444; --line: #bbb; --box: #fff; --edge: #888; --good: #17703a;
    --warn: #8a4b00; --warn-box: #fff; --bad: #a3141f; --bad-box: #fff }
  body { padding: 0; max-width: none; font-size: 10pt }
  .figures { grid-template-columns: repeat(4, minmax(0, 1fr)) }
  pre { border: 1px solid var(--line) }
  h2, h3 { break-after: avoid }
  tr, .curves > * { break-inside: avoid }
}
"""
STYLE = _STYLE.replace("@BLOCKS@", _BLOCKS).replace("@DENSE@", _BLOCKS.replace(".rows", ".dense"))

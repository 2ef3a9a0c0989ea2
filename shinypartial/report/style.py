"""The style sheet of the report: one column on a phone, a grid on a desk, and the reader's choice of light or dark."""

STYLE = """
:root { color-scheme: light dark; --ink: #1b1d21; --dim: #5d6470; --page: #fbfbfa; --card: #fff; --rule: #dfe1e5;
  --accent: #1f6feb; --warn: #9a3412; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7e8ea; --dim: #9aa1ac; --page: #121417; --card: #1b1e23;
  --rule: #30343b; --accent: #6ea8fe; --warn: #fdba74; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1180px; padding: 1.2rem; background: var(--page); color: var(--ink);
  font: 15px/1.5 system-ui, sans-serif; }
h1 { font-size: 1.5rem; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
p { margin: .3rem 0; max-width: 72ch; }
.dim, figcaption { color: var(--dim); }
.warn { color: var(--warn); font-weight: 600; }
.cards { display: grid; grid-template-columns: repeat(4, minmax(0, 1fr)); gap: .7rem; margin: 1rem 0; }
.card { background: var(--card); border: 1px solid var(--rule); border-radius: 8px; padding: .6rem .8rem; }
.card b { display: block; font-size: 1.3rem; font-variant-numeric: tabular-nums; }
.card span { color: var(--dim); font-size: .82rem; line-height: 1.3; display: block; }
.maps { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(340px, 100%), 1fr)); gap: 1rem; }
.charts { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(320px, 100%), 1fr)); gap: 1rem;
  margin-top: 1rem; }
.trio { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: .5rem; align-items: start;
  margin-bottom: .7rem; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(210px, 46%), 1fr)); gap: 1rem; }
.views { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(480px, 100%), 1fr)); gap: .4rem 1.6rem; }
figure { margin: 0; }
figure img { width: 100%; height: auto; display: block; border-radius: 4px; background: #606060; }
figcaption { font-size: .8rem; line-height: 1.35; margin-top: .25rem; overflow-wrap: anywhere; }
.legend { display: flex; align-items: center; gap: .4rem; font-size: .75rem; color: var(--dim); margin-top: .3rem; }
.legend i { flex: 1; height: 9px; border-radius: 3px; min-width: 20px; }
.legend span { white-space: nowrap; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .88rem; }
th, td { text-align: left; padding: .28rem .6rem .28rem 0; border-bottom: 1px solid var(--rule); vertical-align: top; }
th { color: var(--dim); font-weight: 600; }
td.number, th.number { text-align: right; white-space: nowrap; }
td:first-child { min-width: 10rem; }
td.text { overflow-wrap: anywhere; }
code { font-size: .82rem; color: var(--dim); overflow-wrap: anywhere; }
svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--rule); border-radius: 6px; }
svg text { font-size: 11px; fill: var(--dim); }
svg .grid { stroke: var(--rule); stroke-width: 1; }
svg .line { fill: none; stroke: var(--accent); stroke-width: 1.6; stroke-linejoin: round; }
summary { cursor: pointer; color: var(--accent); }
@media (max-width: 700px) { .cards { grid-template-columns: repeat(2, minmax(0, 1fr)); } }
@media (max-width: 520px) { body { padding: .8rem; } .card b { font-size: 1.15rem; } code.name { display: none; } }
"""

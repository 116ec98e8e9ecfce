"""HTML reports: stand-alone pages from jinja2 templates, with plotly charts and embedded pictures.

A report lists its contents; the kit lays them out, one look for all. `page.Page` holds title, lead
sentence, warnings and sections of blocks (`blocks`: pictures, grids, tables, figures with unit and
meaning, charts, folded text), `page.write` writes it whole. `charts` makes the plots,
`pictures` colours errors and depths; floors from above are drawn by `core.floor_map`.

A page is one file that opens offline: pictures are embedded, and plotly.js is inlined once where a
chart is shown. All text is escaped. A page with a script of its own extends `templates/base.html`
by a template of its own (`page.render`).

  page.write(
    path,
    Page("Walks", "Four walks on carpet.", [
      Section("Speed", "Mean over a walk.", [
        Figures([Figure("speed", 0.21, "m/s", "along the path", "higher")]),
        charts.lines("walk 1", "time [s]", "speed [m/s]", [Curve("speed", BLUE, time, speed)]),
      ]),
    ]),
  )
"""

"""The report page of a run: tables, plots and the pressure on the pads.

For jobs: `build` makes the parts (`data`) of the values of a run, `page` writes them. Needs the
extra `report` (matplotlib, jinja2).
"""

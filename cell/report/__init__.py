"""The report page of a recording: tables, plots and the pressure on the pads.

For interfaces: `recorded` makes the values (`data`) of a recording, with the parts of `build`;
`page` writes them. Needs the extra `report` (matplotlib, jinja2).
"""

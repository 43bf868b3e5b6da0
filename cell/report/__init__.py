"""The report page of a recording: tables, plots and the pressure on the pads.

`recorded` computes the values (`data`) of a recording with the functions of `build`; `page` writes
them. Needs the extra `report` (matplotlib, jinja2).
"""

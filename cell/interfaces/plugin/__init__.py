"""The plugin that a host program loads (entry point `tactile_cell` of `robot_cell.plugins`).

For hosts: `plugin.TactileCellPlugin`. Inside: `goals` (requests and their checks), `answer` (what
an identification returns), `tasks` (teach and identify), `worker` (the thread of a cell),
`lease` (who commands; a host that falls silent).
"""

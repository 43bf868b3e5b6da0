"""DFRobot SEN0704 tactile sensors for tactile-cell."""

"""The package's own plugin, loaded after pytest-cov has started.

Users get it as an entry point, which pytest imports before; `addopts` in pyproject.toml blocks that
here. A run that overrides `addopts` has it already.
"""

import sys

_NAME = "cell.pytest_plugin"
pytest_plugins = ["pytester", *([] if _NAME in sys.modules else [_NAME])]

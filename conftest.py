"""The package's own plugin, loaded after pytest-cov has started; users get it as an entry point."""

pytest_plugins = ["cell.pytest_plugin", "pytester"]

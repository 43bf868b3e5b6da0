"""The paper's study: its figures, tables and claims, and the mathematics behind them."""

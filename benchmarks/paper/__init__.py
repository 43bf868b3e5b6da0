"""The paper's study: its figures, tables and claims."""

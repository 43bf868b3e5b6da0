"""The archive: the grasps of many cells and days as one table of Parquet files, and its answers.

For jobs and interfaces: `store` keeps the table. `ingest` fills it from recordings and data sets,
`questions` and `page` make its report. All work in pieces, so memory does not grow with the
archive. Needs the extra `archive`.
"""

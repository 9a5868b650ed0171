"""Writers of files for other programs: one module per format, and ``formats`` with the table of them all."""

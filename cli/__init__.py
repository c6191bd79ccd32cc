"""The ``ppcbf`` command: results on stdout, progress and errors on stderr."""

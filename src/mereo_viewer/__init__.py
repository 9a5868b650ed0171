"""The browser pages of ``mereo view``: of a result, with what was observed, and the laboratory of an object."""

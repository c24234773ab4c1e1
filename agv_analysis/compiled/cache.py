"""Where numba keeps what `compiled` compiles: in a folder named after all that went in, wherever the sources lie.

numba's own way puts a hash of the sources' path into it, so that each clone of a repository, and each copy of a
package, compiles everything again. Imported by numba itself, by name.
"""

from __future__ import annotations

from numba.core.caching import UserProvidedCacheLocator


class ContentLocator(UserProvidedCacheLocator):
    """The folder in `numba.config.CACHE_DIR` as it is."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Nothing of the path of the source."""
        return ""

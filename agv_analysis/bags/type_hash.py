"""Whether a type's definition is the one whose hash stands beside it in a bag.

A wrong definition decodes sound bytes to wrong numbers: two fields that have changed places, an integer read as a
float. Where the recorder wrote down the hash of the type that it saw on DDS, such a lie shows.

Source: ROS 2's REP-2016, RIHS01: SHA-256 over names and types of the fields, and of those of all types in them.
"""

from __future__ import annotations

import functools

_VERSION = "RIHS01_"


@functools.lru_cache(1024)
def contradicts(name: str, text: str, type_hash: str) -> bool:
    """Does the definition of type `name` in ROS 2's message language have another hash than the one recorded?

    No, if none is recorded, if it is of another version, or if rosbags, which computes it, does not know the language.
    """
    if not type_hash.startswith(_VERSION):
        return False
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(text, name))
        return store.hash_rihs01(name) != type_hash
    except Exception:  # rosbags lets through what its parser raises; what it cannot read it cannot judge
        return False

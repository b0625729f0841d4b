"""By what sources notice that another file has taken the place of the one that they read."""

# Bytes of the beginning of a file by which it is recognised: on a disk, and where its ETag or date differs, as between
# the nodes of a server. They hold the header of a .kpc file and so the checksum of its index, which holds those of all
# chunks.
BEGINNING_BYTES = 512

"""The reference: footprints fetched and read, described tile by tile, kept in one database."""

"""Reference data: where building footprints come from and what becomes of them."""

"""Pages in millimetres, one writer for each file format, sheets and their sidecars."""

"""From diagnostics to verdicts: the only room that decides (method.md section 7)."""

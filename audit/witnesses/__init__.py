"""What does evidence outside of the image say? (method.md section 13). Measures, and decides nothing.

`evidence` says what a witness may look at and what it reports; `asking` is the one list of those that are asked.
"""

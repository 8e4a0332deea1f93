"""What did a Python user ask for? One reconstruction, audited: tables, one image's story, its picture."""

"""From the records of any format to the one model, with a finding for every inconsistency."""

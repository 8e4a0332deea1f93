"""Where does an input lie, on this machine or in an object store, and how are its bytes read? Formats come later."""

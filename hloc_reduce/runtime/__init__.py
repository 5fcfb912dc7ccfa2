"""How work is done and survives: outputs folders, files, processes, machines."""

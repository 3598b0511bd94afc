if __name__ != "list3r.memory":  # by the root's link this would be a second copy, whose classes are not ours
    raise ImportError("import list3r.memory: the folder memory at the root is a link to it")

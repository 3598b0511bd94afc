if __name__ != "list3r.exporters":  # by the root's link this would be a second copy, whose classes are not ours
    raise ImportError("import list3r.exporters: the folder exporters at the root is a link to it")

if __name__ != "list3r.exporters":  # imported through the root's link this would be a second copy with other classes
    raise ImportError("import list3r.exporters: the folder exporters at the root is a link to it")

if __name__ != "list3r.queries":  # by the root's link this would be a second copy, whose classes are not ours
    raise ImportError("import list3r.queries: the folder queries at the root is a link to it")

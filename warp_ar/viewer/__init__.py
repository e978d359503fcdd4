"""The live page: a server that shows lit frames in a browser, takes its camera, and lets the scene be edited.

``host`` runs frames on a thread, ``edits`` changes scenes, ``protocol`` is what page and server may say to each other,
``server`` is the only module that speaks HTTP.
"""

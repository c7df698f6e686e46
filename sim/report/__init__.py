"""A flight as one HTML page that needs no network: `fleet report`.

series      what is drawn: motion, errors, distances and messages over time, from a flight's recordings
drawings    each figure as SVG
page        figures, criteria and tables as one file
"""

"""Zenoh as the fleet's transport: the only package that imports `zenoh`.

configuration  what a session is given: fleet, profile, endpoints, limits against floods
session        opens and closes one
vehicle        a vehicle's end, whose callbacks only enqueue
operator       an operator's end: presence, questions and their answers
traffic        bytes on the wire
"""

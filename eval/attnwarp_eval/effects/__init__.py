"""Light transport: which effects a scene calls for, the cheapest plan that shows them, and its
proof.
"""

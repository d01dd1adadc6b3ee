"""Light transport: effects that a scene needs, the cheapest plan that shows them, its proof."""

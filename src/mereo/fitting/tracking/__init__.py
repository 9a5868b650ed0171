"""An object followed from frame to frame, each fit from the last one."""

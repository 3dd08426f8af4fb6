"""An agent on a vision-language model: it proposes grasps on a picture, splits tasks into steps, and plans anew.

Models are asked through any endpoint that speaks the chat completions of OpenAI; recorded conversations and a geometric
stand-in take their place without one. Needs the extra `vlm`.
"""

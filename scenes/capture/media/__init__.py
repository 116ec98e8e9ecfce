"""What cameras leave behind: videos and photographs."""

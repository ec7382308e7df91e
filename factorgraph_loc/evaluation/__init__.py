"""What results are judged by: metrics, statistics, tables and plots."""

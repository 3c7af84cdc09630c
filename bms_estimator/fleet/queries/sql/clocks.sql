-- Packs whose edge's clock is wrong, with their last error and the end of the last hour on their clock. Needs: quarantined.
SELECT
    pack, to_timestamp((arg_max(hour, revision)::BIGINT + 1) * 3600)::TIMESTAMP AS edge_time,
    arg_max(q.clock_error_s, revision) AS clock_error_s, count(*) AS quarantined_hours,
    to_timestamp(min(received_hour) * 3600)::TIMESTAMP AS first_received,
    to_timestamp(max(received_hour) * 3600)::TIMESTAMP AS last_received
FROM quarantined q
GROUP BY pack
ORDER BY last_received DESC, pack

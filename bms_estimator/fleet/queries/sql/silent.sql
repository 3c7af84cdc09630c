-- Packs without recent hours. Needs: packs, days.
SELECT
    type, p.pack, to_timestamp((p.last_hour::BIGINT + 1) * 3600)::TIMESTAMP AS silent_since, $now_hour - p.last_hour AS hours_silent,
    d.soc, d.soc_std, d.temperature_c
FROM packs p JOIN days d ON d.pack = p.pack AND d.last_hour = p.last_hour
WHERE $now_hour - p.last_hour > $silent_hours
ORDER BY p.last_hour DESC, p.pack

"""Requests to the page that no browser would send, drawn at random; none of them may change anything."""

from __future__ import annotations

import random

BODY = b'{"do": "mode", "value": "AUTO", "who": "x"}'


def whole(rng: random.Random, port: int, token: str) -> bytes:
    """A change with at least one fault that is well framed, so that the connection lives on."""
    host = b"127.0.0.1:%d" % port
    fields = {
        b"Host": host,
        b"Origin": b"http://" + host,
        b"Content-Type": b"application/json",
        b"Authorization": b"Bearer " + token.encode(),
    }
    faults = {
        b"Host": [b"evil.example", b"evil.example:%d" % port, b"localhost.:%d" % port, host + b".evil", b"", b"::1"],
        b"Origin": [b"null", b"https://evil.example", b"http://" + host + b".evil", b"https://" + host,
                    b"http://evil@" + host],
        b"Content-Type": [b"text/plain", b"application/x-www-form-urlencoded", b"multipart/form-data", b"",
                          b"application/jsonp"],
        b"Authorization": [b"Bearer x", b"Bearer", b"", b"Basic " + token.encode(), b"Bearer " + token.encode() + b"x",
                           b"Bearer " + token[:-1].encode(), b"bearer:" + token.encode(),
                           rng.randbytes(9).hex().encode()],
    }  # fmt: skip
    for name in rng.sample(sorted(faults), rng.randint(1, 3)):
        if name != b"Host" and rng.random() < 0.2:
            del fields[name]
        else:
            fields[name] = rng.choice(faults[name])
    target = rng.choice(
        [b"/api/change", b"/api/change", b"/api/change?token=" + token.encode(), b"/api/change/", b"/api/%63hange",
         b"//api/change", b"/static/../api/change", b"http://" + host + b"/api/change", b"*"]
    )  # fmt: skip
    method = rng.choice([b"POST"] * 6 + [b"PUT", b"PATCH", b"DELETE", b"OPTIONS", b"TRACE"])
    body = rng.choice([BODY, BODY, b"", b"{" * 3_000, rng.randbytes(50), BODY + b"A" * 20_000])
    extra = rng.choice(
        [b"", b"", b"X-Forwarded-Host: " + host, b"Forwarded: host=" + host, b"X-HTTP-Method-Override: POST",
         b"Cookie: token=" + token.encode(), b"X-A: " + b"a" * 5_000, b"Sec-Fetch-Site: cross-site"]
    )  # fmt: skip
    lines = [method + b" " + target + b" HTTP/1.1", *(name + b": " + value for name, value in fields.items())]
    lines += [b"Content-Length: %d" % len(body), *([extra] if extra else [])]
    return b"\r\n".join(lines) + b"\r\n\r\n" + body


def broken(rng: random.Random, port: int) -> bytes:
    """A change without the token, damaged so that the server may give the connection up."""
    body = BODY
    lines = [
        b"POST /api/change HTTP/1.1", b"Host: 127.0.0.1:%d" % port, b"Origin: http://127.0.0.1:%d" % port,
        b"Content-Type: application/json", b"Content-Length: %d" % len(body), b"Authorization: Bearer x",
    ]  # fmt: skip
    for _ in range(rng.randint(1, 3)):
        place = rng.randrange(len(lines))
        how = rng.randrange(8)
        if how == 0:
            del lines[place]
        elif how == 1:
            lines.insert(place, lines[rng.randrange(len(lines))])
        elif how == 2:
            line = bytearray(lines[place])
            line[rng.randrange(len(line))] = rng.randrange(256)
            lines[place] = bytes(line)
        elif how == 3:
            lines[place] += b"A" * rng.choice([100, 20_000])
        elif how == 4:
            lines.append(
                rng.choice([b"Transfer-Encoding: chunked", b"Content-Length: -1", b"Content-Length: 99999999"])
            )
        elif how == 5:
            lines[0] = rng.choice(
                [b"GET /%00 HTTP/1.1", b"PUT /api/change HTTP/1.1", b"GET //x HTTP/9.9", b"\x16\x03\x01"]
            )
        elif how == 6:
            body = rng.randbytes(rng.randrange(200))
        else:
            lines[0] = b"GET /api/trend?from=%s&to=%s HTTP/1.1" % (rng.randbytes(4).hex().encode(), rng.randbytes(4))
        if not lines:
            break
    return b"\r\n".join(lines) + b"\r\n\r\n" + body

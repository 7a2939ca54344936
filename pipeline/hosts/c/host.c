/* A Loopwright controller file in C11, on onnxruntime's C API and POSIX clocks.

     host FILE.onnx [SCANS [PERIOD_S [NAME=VALUE ...]]]   a loop on a made-up plant; put yours into plant_read and
                                                  plant_write. NAME=VALUE: of what operators may change, as y0.low=-1
     host --conformance KIT [ANSWERS.json]        the kit of `loopwright conformance FILE.onnx KIT`

   The parts: JSON, SHA-256, controller (beside controller.c, which lies beside this file), loop, plant, run, conformance,
   main. To use the controller and the loop in a
   program of your own, define LOOPWRIGHT_NO_MAIN and include this file. Nothing is allocated after
   controller_open. No function sets the locale; strtod needs the "C" one, which a C program starts with. */

#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "controller.c"
#include "onnxruntime_c_api.h"

/* Largest file, depth of lists in lists, keys of an object that is compared and entries of operate: with them the time that
   is spent on a file grows as its size, whatever is in it. */
enum { MAX_BYTES = 64 << 20, MAX_DEPTH = 24, MAX_KEYS = 256, MAX_ENTRIES = 1024, LINE = 64 };

/* ------------------------------------------------------------------ JSON: a tree, strictly enough for our own files */
typedef struct Json Json;
struct Json {
  enum { J_NULL, J_FALSE, J_TRUE, J_NUMBER, J_TEXT, J_LIST, J_OBJECT } kind;
  double number;
  char *text;
  Json *items; /* of a list or an object */
  char **keys; /* of an object */
  size_t n;
};

static void json_free(Json *j) {
  for (size_t i = 0; i < j->n; i++) {
    json_free(&j->items[i]);
    if (j->keys) free(j->keys[i]);
  }
  free(j->items);
  free(j->keys);
  free(j->text);
  memset(j, 0, sizeof *j);
}

static const char *blanks(const char *p) { return p + strspn(p, " \t\r\n"); }

/* The number that four hexadecimal digits stand for, or -1. */
static int hex_digits(const char *p) {
  int code = 0;
  for (int k = 0; k < 4; k++) {
    const char *digits = "0123456789abcdef0123456789ABCDEF", *at = p[k] ? strchr(digits, p[k]) : NULL;
    if (!at) return -1;
    code = 16 * code + (int)(at - digits) % 16;
  }
  return code;
}

/* The text behind an opening quote. Escapes beyond ASCII become '?': they stand in names for people only. */
static const char *json_text(const char *p, char **text) {
  const char *end = p;
  while (*end && *end != '"') end += *end == '\\' && end[1] ? 2 : 1;
  char *to = *text = malloc((size_t)(end - p) + 1);
  if (!to || *end != '"') return NULL;
  while (p < end) {
    if (*p != '\\') {
      *to++ = *p++;
      continue;
    }
    const char *from = strchr("\"\\/bfnrt", p[1]), *plain = "\"\\/\b\f\n\r\t";
    if (p[1] == 'u') {
      int code = end - p < 6 ? -1 : hex_digits(p + 2); /* not sscanf, which measures all the text behind it */
      if (code < 0) return NULL;
      *to++ = code && code < 128 ? (char)code : '?';
      p += 6;
    } else if (from) {
      *to++ = plain[from - "\"\\/bfnrt"];
      p += 2;
    } else {
      return NULL;
    }
  }
  *to = 0;
  return end + 1;
}

static const char *json_value(const char *p, Json *j, int depth);

static const char *json_items(const char *p, Json *j, int depth, char end) {
  size_t room = 0;
  p = blanks(p);
  if (*p == end) return p + 1;
  for (;;) {
    if (j->n == room) {
      room = room ? 2 * room : 8;
      Json *items = realloc(j->items, room * sizeof *items);
      if (!items) return NULL;
      j->items = items;
      if (j->kind == J_OBJECT) {
        char **keys = realloc(j->keys, room * sizeof *keys);
        if (!keys) return NULL;
        j->keys = keys;
      }
    }
    memset(&j->items[j->n], 0, sizeof *j->items);
    if (j->kind == J_OBJECT) {
      j->keys[j->n] = NULL;
      p = blanks(p);
      j->n++; /* from here on json_free sees it */
      if (*p != '"' || !(p = json_text(p + 1, &j->keys[j->n - 1])) || *(p = blanks(p)) != ':') return NULL;
      p++;
    } else {
      j->n++;
    }
    if (!(p = json_value(p, &j->items[j->n - 1], depth + 1))) return NULL;
    p = blanks(p);
    if (*p == end) return p + 1;
    if (*p++ != ',') return NULL;
  }
}

static const char *json_value(const char *p, Json *j, int depth) {
  static const struct { const char *word; int kind; } WORD[] = {{"null", J_NULL}, {"false", J_FALSE}, {"true", J_TRUE}};
  p = blanks(p);
  if (depth > MAX_DEPTH) return NULL;
  if (*p == '"') {
    j->kind = J_TEXT;
    return json_text(p + 1, &j->text);
  }
  if (*p == '[' || *p == '{') {
    j->kind = *p == '[' ? J_LIST : J_OBJECT;
    return json_items(p + 1, j, depth, *p == '[' ? ']' : '}');
  }
  for (size_t i = 0; i < 3; i++) {
    if (!strncmp(p, WORD[i].word, strlen(WORD[i].word))) {
      j->kind = WORD[i].kind;
      return p + strlen(WORD[i].word);
    }
  }
  char *end;
  j->kind = J_NUMBER;
  j->number = strtod(p, &end);
  return end > p ? end : NULL;
}

static const Json *json_get(const Json *j, const char *key) {
  for (size_t i = 0; j && j->kind == J_OBJECT && i < j->n; i++)
    if (!strcmp(j->keys[i], key)) return &j->items[i];
  return NULL;
}

static const char *json_word(const Json *j, const char *key) {
  const Json *found = json_get(j, key);
  return found && found->kind == J_TEXT ? found->text : "";
}

/* Whether two values say the same; the order of an object's entries says nothing. */
static bool json_same(const Json *a, const Json *b) {
  if (!a || !b || a->kind != b->kind || a->n != b->n) return false;
  if (a->kind == J_NUMBER) return a->number == b->number;
  if (a->kind == J_TEXT) return !strcmp(a->text, b->text);
  if (a->kind == J_OBJECT && a->n > MAX_KEYS) return false;
  for (size_t i = 0; i < a->n; i++)
    if (!json_same(&a->items[i], a->kind == J_OBJECT ? json_get(b, a->keys[i]) : &b->items[i])) return false;
  return true;
}

/* A number, or a hexadecimal float as text; NAN where there is neither. */
static double json_number(const Json *j) {
  if (j && j->kind == J_NUMBER) return j->number;
  if (!j || j->kind != J_TEXT) return NAN;
  char *end;
  double value = strtod(j->text, &end);
  return end > j->text && !*end ? value : NAN;
}

/* ------------------------------------------------------------------ files, and SHA-256 (FIPS 180-4) */
static char *read_file(const char *path, size_t *size) {
  FILE *file = fopen(path, "rb");
  if (!file) return NULL;
  char *bytes = malloc(MAX_BYTES + 1), *fit = NULL;
  if (bytes) {
    *size = fread(bytes, 1, MAX_BYTES, file);
    bool whole = *size < MAX_BYTES && !ferror(file);
    bytes[*size] = 0;
    fit = whole ? realloc(bytes, *size + 1) : NULL;
    if (!fit) free(bytes);
  }
  fclose(file);
  return fit;
}

static bool json_object(const char *text, Json *j) {
  memset(j, 0, sizeof *j);
  const char *end = json_value(text, j, 0);
  return end && !*blanks(end) && j->kind == J_OBJECT;
}

static bool read_json(const char *path, Json *j, char *words) {
  size_t size = 0;
  char *text = read_file(path, &size);
  memset(j, 0, sizeof *j);
  if (!text) {
    snprintf(words, WORDS, "%.300s cannot be read: %s", path, strerror(errno));
    return false;
  }
  bool good = strlen(text) == size && json_object(text, j);
  free(text);
  if (!good) {
    snprintf(words, WORDS, "%.300s is no JSON object", path);
    json_free(j);
  }
  return good;
}

static uint32_t turned(uint32_t x, int n) { return x >> n | x << (32 - n); }

static void sha256(const uint8_t *data, size_t size, char hex[65]) {
  static const uint32_t K[64] = {
      0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
      0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
      0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
      0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
      0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
      0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
      0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
      0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};
  uint32_t h[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a, 0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
  size_t blocks = (size + 8) / 64 + 1;
  for (size_t b = 0; b < blocks; b++) {
    uint32_t w[64];
    for (size_t i = 0; i < 16; i++) {
      w[i] = 0;
      for (size_t k = 0; k < 4; k++) {
        size_t at = 64 * b + 4 * i + k;
        uint8_t byte = at < size ? data[at] : at == size ? 0x80 : 0;
        if (b == blocks - 1 && 4 * i + k >= 56) byte = (uint8_t)((uint64_t)size * 8 >> 8 * (63 - (4 * i + k)));
        w[i] = w[i] << 8 | byte;
      }
    }
    for (size_t i = 16; i < 64; i++) {
      uint32_t a = w[i - 15], e = w[i - 2];
      w[i] = w[i - 16] + (turned(a, 7) ^ turned(a, 18) ^ a >> 3) + w[i - 7] + (turned(e, 17) ^ turned(e, 19) ^ e >> 10);
    }
    uint32_t v[8];
    memcpy(v, h, sizeof v);
    for (size_t i = 0; i < 64; i++) {
      uint32_t s1 = turned(v[4], 6) ^ turned(v[4], 11) ^ turned(v[4], 25);
      uint32_t s0 = turned(v[0], 2) ^ turned(v[0], 13) ^ turned(v[0], 22);
      uint32_t t1 = v[7] + s1 + ((v[4] & v[5]) ^ (~v[4] & v[6])) + K[i] + w[i];
      uint32_t t2 = s0 + ((v[0] & v[1]) ^ (v[0] & v[2]) ^ (v[1] & v[2]));
      memmove(v + 1, v, 7 * sizeof *v);
      v[4] += t1;
      v[0] = t1 + t2;
    }
    for (size_t i = 0; i < 8; i++) h[i] += v[i];
  }
  for (size_t i = 0; i < 8; i++) snprintf(hex + 8 * i, 9, "%08x", (unsigned)h[i]);
}

/* ------------------------------------------------------------------ the controller on onnxruntime */
struct Graph {
  Json manifest; /* the one inside the file */
  const OrtApi *ort;
  OrtEnv *env;
  OrtSession *session;
  OrtValue *in_value[INPUTS], *out_value[OUTPUTS];
};

static bool good(Controller *c, OrtStatus *status) {
  if (!status) return true;
  failed(c, "onnxruntime: %s", c->graph->ort->GetErrorMessage(status));
  c->words[strcspn(c->words, "\r\n")] = 0;
  c->graph->ort->ReleaseStatus(status);
  return false;
}

static bool read_signals(Controller *c, const char *key, Signals *signals) {
  const Json *list = json_get(&c->graph->manifest, key);
  if (!list || list->kind != J_LIST) return failed(c, "the manifest has no list %s", key);
  signals->n = list->n;
  Signal *at = calloc(list->n + 1, sizeof *at);
  if (!(signals->at = at)) return failed(c, "no memory");
  for (size_t i = 0; i < list->n; i++) {
    Signal *s = &at[i];
    const Json *row = &list->items[i], *values = json_get(row, "values");
    *s = (Signal){.name = json_word(row, "name"), .unit = json_word(row, "unit")};
    s->low = json_number(json_get(row, "low"));
    s->high = json_number(json_get(row, "high"));
    if (!(s->low < s->high) || !isfinite(s->high - s->low)) return failed(c, "%s %s has no range", key, s->name);
    const Json *move = json_get(row, "max_move");
    s->max_move = move && move->kind != J_NULL ? json_number(move) : INFINITY;
    if (!(s->max_move > 0)) return failed(c, "%s %s has a max_move that is not above 0", key, s->name);
    if (!values || values->kind != J_LIST) continue;
    double *allowed = calloc(values->n + 1, sizeof *allowed);
    if (!(s->values = allowed)) return failed(c, "no memory");
    s->n_values = values->n;
    s->max_move = INFINITY; /* it has no way between its values */
    for (size_t k = 0; k < values->n; k++) allowed[k] = json_number(&values->items[k]);
  }
  return true;
}

static bool read_operate(Controller *c) {
  const Json *list = json_get(&c->graph->manifest, "operate");
  size_t n = c->n_in[OPERATE] = list && list->kind == J_LIST ? list->n : 0;
  if (list && list->kind != J_LIST) return failed(c, "the manifest's operate is no list");
  if (n > MAX_ENTRIES) return failed(c, "the manifest's operate has more than %d entries", MAX_ENTRIES);
  Operate *entries = calloc(n + 1, sizeof *entries);
  if (!(c->operate_entries = entries)) return failed(c, "no memory");
  for (size_t i = 0; i < n; i++) {
    const Json *row = &list->items[i];
    const char *signal = json_word(row, "signal"), *what = json_word(row, "what");
    Operate *e = &entries[i];
    size_t room = strlen(signal) + strlen(what) + 2;
    char *name = malloc(room);
    if (!(e->name = name)) return failed(c, "no memory");
    snprintf(name, room, "%s%s%s", signal, *signal ? "." : "", what);
    e->unit = json_word(row, "unit");
    e->standard = json_number(json_get(row, "default"));
    e->low = json_number(json_get(row, "low"));
    e->high = json_number(json_get(row, "high"));
    e->of_cv = !strcmp(json_word(row, "group"), "cv");
    e->is_switch = !strcmp(what, "use") || !strcmp(what, "track") || !strcmp(what, "rest_use");
    if (!(e->low <= e->standard && e->standard <= e->high) || !isfinite(e->high - e->low))
      return failed(c, "operate: %.200s has no range with a default in it", e->name);
  }
  for (size_t i = 0; i < n; i++) {
    char name[WORDS];
    Operate *e = &entries[i];
    size_t stem = strlen(e->name);
    e->above = i;
    if (strcmp(json_word(&list->items[i], "what"), "low")) continue;
    snprintf(name, sizeof name, "%.*shigh", (int)(stem - 3), e->name);
    if ((e->above = operate_place(c, name)) == n) return failed(c, "operate: %.200s stands without a high end", e->name);
  }
  return true;
}

/* By how much set points and measured disturbances will differ from now: at each of the horizon's samples one number of
   each signal, set points first. */
static bool read_ahead(Controller *c) {
  const Json *ahead = json_get(&c->graph->manifest, "ahead"), *signals = json_get(ahead, "signals");
  size_t n = c->n_in[SP] + c->n_in[DV];
  double horizon = json_number(json_get(ahead, "horizon"));
  if (!ahead) return true;
  if (!(horizon >= 1 && horizon <= 10000 && horizon == floor(horizon))) return failed(c, "the manifest's ahead has no horizon");
  if (json_number(json_get(ahead, "period_s")) != json_number(json_get(&c->graph->manifest, "period_s")))
    return failed(c, "the manifest's ahead has another period than its law");
  if (!signals || signals->kind != J_LIST || signals->n != n)
    return failed(c, "the manifest's ahead does not list the set points and measured disturbances");
  for (size_t k = 0; k < n; k++) {
    const Signal *s = k < c->n_in[SP] ? &c->signals[SP].at[k] : &c->signals[DV].at[k - c->n_in[SP]];
    if (strcmp(json_word(&signals->items[k], "signal"), s->name))
      return failed(c, "the manifest's ahead has another order than its set points and measured disturbances");
  }
  double *low = calloc(n + 1, sizeof *low), *high = calloc(n + 1, sizeof *high);
  c->ahead_low = low, c->ahead_high = high;
  if (!low || !high) return failed(c, "no memory");
  for (size_t k = 0; k < n; k++) {
    low[k] = json_number(json_get(&signals->items[k], "low"));
    high[k] = json_number(json_get(&signals->items[k], "high"));
  }
  c->n_in[AHEAD] = (size_t)horizon * n;
  return true;
}

/* The manifest inside the file. Entries that a host acts on must stand in the JSON beside it too: whoever changed
   that one would else be shown other ranges than those that hold. */
static bool find_manifest(Controller *c, const Json *beside) {
  static const char *const ACTED_ON[] = {"schema", "period_s", "inputs", "n_state", "info", "sp", "pv", "dv", "mv", "operate", "ahead"};
  OrtModelMetadata *metadata = NULL;
  OrtAllocator *allocator = NULL;
  char *text = NULL;
  bool found = good(c, c->graph->ort->SessionGetModelMetadata(c->graph->session, &metadata)) &&
               good(c, c->graph->ort->GetAllocatorWithDefaultOptions(&allocator)) &&
               good(c, c->graph->ort->ModelMetadataLookupCustomMetadataMap(metadata, allocator, "loopwright.manifest", &text));
  if (found && (!text || !json_object(text, &c->graph->manifest))) found = failed(c, "the file holds no manifest");
  for (size_t i = 0; found && i < sizeof ACTED_ON / sizeof *ACTED_ON; i++) {
    const Json *inside = json_get(&c->graph->manifest, ACTED_ON[i]), *other = json_get(beside, ACTED_ON[i]);
    if ((inside || other) && !json_same(inside, other))
      found = failed(c, "the JSON beside the file has another %s than the manifest inside it; get both from one place",
                     ACTED_ON[i]);
  }
  if (text) found = good(c, c->graph->ort->AllocatorFree(allocator, text)) && found;
  if (metadata) c->graph->ort->ReleaseModelMetadata(metadata);
  return found;
}

static bool read_manifest(Controller *c) {
  static const char *const KEY[STATE] = {"sp", "pv", "dv", "mv"};
  const Json *m = &c->graph->manifest, *inputs = json_get(m, "inputs"), *info = json_get(m, "info");
  if (json_number(json_get(m, "schema")) != 1) return failed(c, "the manifest's schema is not 1, which this host reads");
  for (int i = 0; i < STATE; i++) {
    if (!read_signals(c, KEY[i], &c->signals[i])) return false;
    c->n_in[i] = c->signals[i].n;
  }
  if (!read_operate(c) || !read_ahead(c)) return false;
  c->n_in[FRESH] = c->n_in[PV];
  double n_state = json_number(json_get(m, "n_state"));
  c->period_s = json_number(json_get(m, "period_s"));
  if (!(n_state >= 0 && n_state <= 1e6 && n_state == floor(n_state))) return failed(c, "the manifest has no n_state");
  if (!(c->period_s >= 1e-6 && c->period_s <= 1e9)) return failed(c, "the manifest has no period");
  if (!inputs || inputs->kind != J_LIST || !info || info->kind != J_LIST || !c->n_in[MV])
    return failed(c, "the manifest lacks inputs, info or mv");
  c->n_in[STATE] = c->n_out[OUT_STATE] = (size_t)n_state;
  c->n_out[OUT_MV] = c->n_in[MV];
  c->n_out[OUT_INFO] = info->n;
  for (size_t k = 0; k < inputs->n; k++) {
    int i = 0;
    while (i < INPUTS && (inputs->items[k].kind != J_TEXT || strcmp(inputs->items[k].text, INPUT[i]))) i++;
    if (i == INPUTS) return failed(c, "the manifest names an input that no controller has");
    c->uses[i] = true;
  }
  if (c->uses[OPERATE] && !c->n_in[OPERATE])
    return failed(c, "the manifest's law reads operate, but the manifest has no entries of it");
  if (c->uses[AHEAD] && !c->n_in[AHEAD])
    return failed(c, "the manifest's law reads ahead, but the manifest does not say what it is");
  for (size_t i = 0; i < c->n_in[MV]; i++)
    if (!c->uses[MV] && c->signals[MV].at[i].max_move < INFINITY)
      return failed(c, "the moves of %s are limited, but its law does not read mv_applied", c->signals[MV].at[i].name);
  return true;
}

/* One vector of the graph: a buffer on a cache line of its own, bound to an onnxruntime value for good. */
static bool bind(Controller *c, const OrtMemoryInfo *where, size_t n, double **buffer, OrtValue **value) {
  size_t bytes = (n * sizeof **buffer / LINE + 1) * LINE;
  if (!(*buffer = aligned_alloc(LINE, bytes))) return failed(c, "no memory");
  memset(*buffer, 0, bytes);
  int64_t shape[1] = {(int64_t)n};
  return !n || good(c, c->graph->ort->CreateTensorWithDataAsOrtValue(where, *buffer, n * sizeof **buffer, shape, 1,
                                                              ONNX_TENSOR_ELEMENT_DATA_TYPE_DOUBLE, value));
}

static bool open_session(Controller *c, const void *bytes, size_t size) {
  OrtSessionOptions *options = NULL;
  bool made = good(c, c->graph->ort->CreateEnv(ORT_LOGGING_LEVEL_FATAL, "loopwright", &c->graph->env)) &&
              good(c, c->graph->ort->CreateSessionOptions(&options)) &&
              good(c, c->graph->ort->SetIntraOpNumThreads(options, 1)) && good(c, c->graph->ort->SetInterOpNumThreads(options, 1)) &&
              good(c, c->graph->ort->SetSessionExecutionMode(options, ORT_SEQUENTIAL)) &&
              good(c, c->graph->ort->SetSessionGraphOptimizationLevel(options, ORT_ENABLE_ALL)) &&
              good(c, c->graph->ort->AddSessionConfigEntry(options, "session.intra_op.allow_spinning", "0")) &&
              good(c, c->graph->ort->AddSessionConfigEntry(options, "session.load_model_format", "ONNX")) &&
              good(c, c->graph->ort->CreateSessionFromArray(c->graph->env, bytes, size, options, &c->graph->session));
  if (options) c->graph->ort->ReleaseSessionOptions(options);
  return made;
}

/* Whether the graph has as many inputs and outputs as the manifest names; onnxruntime checks names and shapes. */
static bool agrees(Controller *c) {
  size_t has[2] = {0}, wanted[2] = {0};
  for (int i = 0; i < INPUTS; i++) wanted[0] += c->uses[i];
  for (int i = 0; i < OUTPUTS; i++) wanted[1] += c->n_out[i] > 0;
  if (!good(c, c->graph->ort->SessionGetInputCount(c->graph->session, &has[0])) ||
      !good(c, c->graph->ort->SessionGetOutputCount(c->graph->session, &has[1])))
    return false;
  if (has[0] == wanted[0] && has[1] == wanted[1]) return true;
  return failed(c, "the graph has %zu inputs and %zu outputs, its manifest %zu and %zu", has[0], has[1], wanted[0],
                wanted[1]);
}

static bool run_graph(Controller *c) {
  const char *in[INPUTS], *out[OUTPUTS];
  const OrtValue *given[INPUTS];
  OrtValue *result[OUTPUTS];
  size_t n = 0, m = 0;
  for (int i = 0; i < INPUTS; i++)
    if (c->uses[i]) in[n] = INPUT[i], given[n++] = c->graph->in_value[i];
  for (int i = 0; i < OUTPUTS; i++)
    if (c->n_out[i]) out[m] = OUTPUT[i], result[m++] = c->graph->out_value[i];
  return good(c, c->graph->ort->Run(c->graph->session, NULL, in, given, n, out, m, result));
}

static void controller_close(Controller *c) {
  Graph *g = c->graph;
  for (int i = 0; i < INPUTS; i++) {
    if (g && g->in_value[i]) g->ort->ReleaseValue(g->in_value[i]);
    free(c->in[i]);
  }
  for (int i = 0; i < OUTPUTS; i++) {
    if (g && g->out_value[i]) g->ort->ReleaseValue(g->out_value[i]);
    free(c->out[i]);
  }
  for (int i = 0; i < STATE; i++) {
    for (size_t k = 0; c->signals[i].at && k < c->signals[i].n; k++) free((void *)c->signals[i].at[k].values);
    free((void *)c->signals[i].at);
  }
  for (size_t i = 0; c->operate_entries && i < c->n_in[OPERATE]; i++) free((void *)c->operate_entries[i].name);
  if (g && g->session) g->ort->ReleaseSession(g->session);
  if (g && g->env) g->ort->ReleaseEnv(g->env);
  free((void *)c->operate_entries);
  free((void *)c->ahead_low);
  free((void *)c->ahead_high);
  free(c->operate);
  free(c->fresh);
  free(c->ahead);
  free(c->state);
  if (g) json_free(&g->manifest);
  free(g);
}

/* Load FILE.onnx and the FILE.json beside it. On false, c->words says why; close it all the same. */
static bool controller_open(Controller *c, const char *path) {
  memset(c, 0, sizeof *c);
  size_t size = 0, stem = strlen(path);
  char beside[4096];
  Json json;
  if (stem < 6 || stem >= sizeof beside || strcmp(path + stem - 5, ".onnx"))
    return failed(c, "%s is no path of a .onnx file", path);
  snprintf(beside, sizeof beside, "%.*s.json", (int)stem - 5, path);
  if (!(c->graph = calloc(1, sizeof *c->graph))) return failed(c, "no memory");
  c->graph->ort = OrtGetApiBase()->GetApi(ORT_API_VERSION);
  if (!c->graph->ort) return failed(c, "onnxruntime %s is older than its header", OrtGetApiBase()->GetVersionString());
  char *bytes = read_file(path, &size);
  if (!bytes) return failed(c, "%s cannot be read: %s", path, strerror(errno));
  bool made = read_json(beside, &json, c->words);
  sha256((const uint8_t *)bytes, size, c->digest);
  if (made && strcmp(json_word(&json, "sha256"), c->digest))
    made = failed(c, "the file's SHA-256 is %s, its manifest's %.64s", c->digest, json_word(&json, "sha256"));
  made = made && open_session(c, bytes, size) && find_manifest(c, &json) && read_manifest(c) && agrees(c);
  free(bytes);
  json_free(&json);
  OrtMemoryInfo *cpu = NULL;
  made = made && good(c, c->graph->ort->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &cpu));
  for (int i = 0; made && i < INPUTS; i++) made = bind(c, cpu, c->n_in[i], &c->in[i], &c->graph->in_value[i]);
  for (int i = 0; made && i < OUTPUTS; i++) made = bind(c, cpu, c->n_out[i], &c->out[i], &c->graph->out_value[i]);
  if (cpu) c->graph->ort->ReleaseMemoryInfo(cpu);
  if (!made) return false;
  c->state = calloc(c->n_in[STATE] + 1, sizeof *c->state);
  c->operate = calloc(c->n_in[OPERATE] + 1, sizeof *c->operate);
  c->fresh = calloc(c->n_in[FRESH] + 1, sizeof *c->fresh);
  c->ahead = calloc(c->n_in[AHEAD] + 1, sizeof *c->ahead);
  if (!c->state || !c->operate || !c->fresh || !c->ahead) return failed(c, "no memory");
  for (size_t k = 0; k < c->n_in[OPERATE]; k++) c->in[OPERATE][k] = c->operate_entries[k].standard;
  if (!controller_operate(c, c->in[OPERATE])) return false;
  for (size_t k = 0; k < c->n_in[FRESH]; k++) c->fresh[k] = c->in[FRESH][k] = 1;
  for (int i = 0; i < STATE; i++)
    for (size_t k = 0; k < c->n_in[i]; k++) c->in[i][k] = middle(&c->signals[i].at[k]);
  return run_graph(c); /* a first step, discarded: a wrong shape shows now, and code and weights are warm */
}


/* ------------------------------------------------------------------ the loop: modes, limits, faults */
#define PV_MARGIN 0.05        /* share of a PV's range beyond which the sensor is broken */
#define BRIDGE_PERIODS 10     /* a law's own prediction is as good as its model, and loads go on unseen meanwhile */
#define READ_BACK_MARGIN 0.02 /* share of an MV's range by which scaling may carry a sound read-back over its ends */

/* The MV is the operator's, the law's, the last one after a fault, or others': in SHADOW nothing is written, and l->mv
   follows what is read back. */
typedef enum { MANUAL, AUTO, HOLD, SHADOW, MODES } Mode;
static const char *const MODE[MODES] = {"MANUAL", "AUTO", "HOLD", "SHADOW"};

typedef struct {
  const double *pv, *dv, *mv_applied; /* mv_applied NULL: there is no read-back */
  double age_s;
} Sample;

typedef struct {
  Controller *c;
  Mode mode;
  bool fault;        /* a fault changed the mode to HOLD */
  int recover_after; /* good samples after which HOLD returns to AUTO; 0: only the operator returns it */
  int good;
  bool lost;      /* the last command did not reach the plant, and nothing has told since where the MV stands */
  bool taken;     /* others had the MV until now, and nothing has told since where it stands */
  double max_gap; /* missed periods in a row after which the law starts cold */
  double *sp, *mv, *applied, *before; /* mv is NAN while nobody knows where it stands */
  /* By PV, for a law that reads fresh: the last good number, periods since then, whether it is bad, predicted, or left
     out of what the law controls now, and whether the loop holds rather than leave it out (set it yourself). */
  double *last, *gone;
  bool *bad, *bridged, *shed, *critical;
  double bridge_s; /* for so long a bad reading is predicted */
  double *pv;      /* numbers for the law */
  double *told;    /* fresh and operate as they were set, while a step has others */
  double *wanted; /* where an operator sent the MV, while by_hand: it goes there by at most its max_move a period */
  bool by_hand;   /* the MV is on its way there */
  bool hand;      /* the MV of the last scan is an operator's, in MANUAL since then */
  bool is_read;   /* a sample has had a read-back, sound or not */
  char reason[WORDS]; /* of the last scan; empty: no fault */
} Loop;

/* Whether it is known where the MV stands: not before the first good sample with a read-back, or loop_set; nor after a
   command that did not arrive, or after SHADOW, until a read-back tells. */
static bool loop_placed(const Loop *l) { return !isnan(l->mv[0]) && !l->lost && !l->taken; }

/* Whether l->mv may be written. */
static bool loop_writes(const Loop *l) { return loop_placed(l) && l->mode != SHADOW; }

static bool loop_open(Loop *l, Controller *c, Mode mode, int recover_after) {
  size_t n = c->n_in[PV] + 1;
  *l = (Loop){.c = c, .mode = mode, .recover_after = recover_after, .max_gap = 3, .bridge_s = BRIDGE_PERIODS * c->period_s};
  l->last = calloc(n, sizeof *l->last);
  l->gone = calloc(n, sizeof *l->gone);
  l->bad = calloc(n, sizeof *l->bad);
  l->bridged = calloc(n, sizeof *l->bridged);
  l->shed = calloc(n, sizeof *l->shed);
  l->critical = calloc(n, sizeof *l->critical);
  l->pv = calloc(n, sizeof *l->pv);
  l->told = calloc(n + c->n_in[OPERATE], sizeof *l->told);
  for (size_t i = 0; l->last && i < n; i++) l->last[i] = NAN;
  l->sp = calloc(c->n_in[SP] + 1, sizeof *l->sp);
  l->mv = calloc(c->n_in[MV] + 1, sizeof *l->mv);
  l->applied = calloc(c->n_in[MV] + 1, sizeof *l->applied);
  l->before = calloc(c->n_in[MV] + 1, sizeof *l->before);
  l->wanted = calloc(c->n_in[MV] + 1, sizeof *l->wanted);
  for (size_t i = 0; l->sp && i < c->n_in[SP]; i++) l->sp[i] = middle(&c->signals[SP].at[i]);
  for (size_t i = 0; l->mv && i < c->n_in[MV]; i++) l->mv[i] = NAN;
  return l->sp && l->mv && l->applied && l->before && l->wanted && l->last && l->gone && l->bad && l->bridged && l->shed &&
         l->critical && l->pv && l->told;
}

static void loop_close(Loop *l) {
  free(l->sp);
  free(l->mv);
  free(l->applied);
  free(l->before);
  free(l->wanted);
  free(l->last);
  free(l->gone);
  free(l->bad);
  free(l->bridged);
  free(l->shed);
  free(l->critical);
  free(l->pv);
  free(l->told);
}

/* Begin the way to where an operator wants the MV. One whose moves are not limited is there, unless all wait for a scan that
   tells where they stand: from a read-back, or at once where there is none; a bad one ends the way. */
static void loop_send(Loop *l, bool wait) {
  l->by_hand = false;
  for (size_t k = 0; k < l->c->n_in[MV]; k++) {
    if (wait || l->c->signals[MV].at[k].max_move < INFINITY) l->by_hand = true;
    else l->mv[k] = l->wanted[k];
  }
}

/* Set points (SP); or the MV (MV) from an operator in MANUAL, to which it goes by at most its max_move a period. False, and
   nothing changed, outside the ranges, for the MV in another mode, and after a command that did not arrive. */
static bool loop_set(Loop *l, int which, const double *values) {
  const Signals *signals = &l->c->signals[which];
  if (which == MV && l->lost)
    return failed(l->c, "the last MV did not reach the plant, so where the MV stands is not known; wait");
  if (which == MV && l->mode != MANUAL)
    return failed(l->c, "the MV is set by hand in MANUAL only; the loop is in %s", MODE[l->mode]);
  for (size_t i = 0; i < signals->n; i++) {
    const Signal *s = &signals->at[i];
    if (!may_be(s, values[i], 0) || (s->values && !among(s, values[i])))
      return failed(l->c, "%s = %g %s is not allowed", s->name, values[i], s->unit);
  }
  memcpy(which == SP ? l->sp : l->wanted, values, signals->n * sizeof *values);
  if (which == MV) {
    l->hand = true;
    loop_send(l, !loop_placed(l));
  }
  return true;
}

/* One period nearer to where an operator sent the MV. */
static void loop_by_hand(Loop *l) {
  bool there = true;
  for (size_t k = 0; k < l->c->n_in[MV]; k++) {
    const Signal *s = &l->c->signals[MV].at[k];
    double way = l->wanted[k] - l->mv[k];
    if (fabs(way) > s->max_move)
      l->mv[k] = fmin(fmax(l->mv[k] + copysign(s->max_move, way), s->low), s->high), there = false;
    else
      l->mv[k] = l->wanted[k];
  }
  l->by_hand = !there;
}

static void loop_set_mode(Loop *l, Mode mode) {
  l->by_hand = l->by_hand && l->mode == mode;
  l->hand = l->hand && l->mode == mode;
  l->taken = mode != SHADOW && (l->taken || l->mode == SHADOW);
  l->mode = mode;
  l->fault = false;
  l->good = 0;
}

/* Periods without readings. */
static void loop_missed(Loop *l, double periods) {
  for (size_t k = 0; k < l->c->n_in[PV]; k++) l->gone[k] += periods;
}

/* So many periods passed without a scan. */
static void loop_gap(Loop *l, double periods) {
  loop_missed(l, periods);
  if (periods > l->max_gap) controller_cold(l->c);
}

/* A fault: no past any more. In AUTO the MV is held until recover_after good samples, or until the operator acts. */
static void loop_fault(Loop *l, const char *reason) {
  snprintf(l->reason, WORDS, "%s", reason);
  controller_cold(l->c);
  l->good = 0;
  if (l->mode == AUTO || l->fault) {
    l->mode = HOLD;
    l->fault = true;
  }
}

/* The last MV never reached the plant, and others may move it meanwhile: nothing is written until a scan has found where
   it stands. */
static void loop_unwritten(Loop *l, const char *reason) {
  size_t n = l->c->n_in[MV];
  bool goes = l->hand && (l->by_hand || !isnan(l->mv[0]));
  if (!l->by_hand) memcpy(l->wanted, l->mv, n * sizeof *l->mv);
  memcpy(l->mv, l->before, n * sizeof *l->mv);
  if (goes) loop_send(l, isnan(l->mv[0])); /* where it should be is where it goes, from where it stands */
  l->lost = true;
  loop_fault(l, reason);
}

/* The first MV whose read-back no actuator can hold; n_in[MV] if there is none. */
static size_t implausible(const Controller *c, const double *applied) {
  size_t k = 0;
  for (; k < c->n_in[MV]; k++) {
    const Signal *s = &c->signals[MV].at[k];
    if (s->values ? !among(s, applied[k]) : !may_be(s, applied[k], READ_BACK_MARGIN)) break;
  }
  return k;
}

static void clip(const Controller *c, const double *applied, double *to) {
  const Signal *s = c->signals[MV].at;
  for (size_t k = 0; k < c->n_in[MV]; k++) to[k] = fmin(fmax(applied[k], s[k].low), s[k].high);
}

/* Why not to act on a sample, in c->words; true if there is no reason. `bad` takes what speaks against single PVs alone;
   NULL: it speaks against the sample. */
static bool trusted(Controller *c, const Sample *sample, bool *bad) {
  const double *const values[STATE] = {[PV] = sample->pv, [DV] = sample->dv};
  for (int i = PV; i <= DV; i++) {
    if (i == DV && !c->uses[DV]) continue;
    if (!values[i] && c->n_in[i]) return failed(c, "the sample has no %s", INPUT[i]);
    for (size_t k = 0; k < c->n_in[i]; k++) {
      bool wrong = !isfinite(values[i][k]) || (i == PV && bad && !may_be(&c->signals[PV].at[k], values[PV][k], PV_MARGIN));
      if (i == PV && bad) bad[k] = wrong;
      else if (wrong) return failed(c, "%s %s is %g", INPUT[i], c->signals[i].at[k].name, values[i][k]);
    }
  }
  size_t wrong = sample->mv_applied ? implausible(c, sample->mv_applied) : c->n_in[MV];
  if (wrong < c->n_in[MV]) {
    const Signal *s = &c->signals[MV].at[wrong];
    return failed(c, "applied MV %s is %g %s, which no actuator can hold", s->name, sample->mv_applied[wrong], s->unit);
  }
  for (size_t k = 0; !bad && k < c->n_in[PV]; k++) {
    const Signal *s = &c->signals[PV].at[k];
    if (!may_be(s, sample->pv[k], PV_MARGIN))
      return failed(c, "PV %s is %g %s, outside its range", s->name, sample->pv[k], s->unit);
  }
  if (!(sample->age_s >= 0 && sample->age_s <= c->period_s))
    return failed(c, "the sample is %g s old; allowed are %g s", sample->age_s, c->period_s);
  return true;
}

/* Where the MV stands after a command that did not arrive, and after others had it: at the next sound read-back, also that
   of a sample which is refused for another reason. A good sample without one says that nothing is read back: the MV before
   it stays, also at once where there has never been a read-back. After a bad one the old MV is nothing to go back to. */
static void loop_found(Loop *l, const double *applied, bool good_one) {
  bool sound = applied && implausible(l->c, applied) == l->c->n_in[MV];
  bool blind = l->by_hand && isnan(l->mv[0]); /* on a way by hand from nobody knows where */
  l->is_read = l->is_read || applied;
  if (!(l->lost || l->taken || blind) || (!applied && !good_one && l->is_read)) return;
  l->by_hand = l->by_hand && !(applied && (l->lost || !sound)); /* it stays where it is found */
  l->lost = l->lost && applied && !sound;
  l->taken = l->taken && applied && !sound;
  if (sound) clip(l->c, applied, l->mv);
  for (size_t k = 0; applied && !sound && k < l->c->n_in[MV]; k++) l->mv[k] = NAN;
}

/* The place in operate of a PV's use; n_in[OPERATE] where it has none. */
static size_t use_of(const Controller *c, size_t pv) {
  char name[WORDS];
  snprintf(name, sizeof name, "%.256s.use", c->signals[PV].at[pv].name);
  size_t i = operate_place(c, name);
  return i < c->n_in[OPERATE] && c->operate_entries[i].of_cv ? i : c->n_in[OPERATE];
}

/* Judge PVs with bad readings, predicted or left out, and put the numbers for the law into l->pv. A law that reads fresh
   goes on without a PV whose reading is bad: for bridge_s it predicts the PV, then its use is 0 until the reading is
   good again. False where no PV is left that is in use, where one is gone for longer that is critical or has
   no use, and where one was never read. */
static bool loop_bridge(Loop *l, const double *pv) {
  Controller *c = l->c;
  size_t n = c->n_in[PV], first = n;
  bool left = false, any = false;
  for (size_t k = 0; k < n; k++) {
    l->gone[k] = l->bad[k] ? l->gone[k] + 1 : 0;
    if (!l->bad[k]) l->last[k] = pv[k];
    l->pv[k] = l->last[k];
  }
  for (size_t k = 0; k < n; k++) {
    const char *name = c->signals[PV].at[k].name;
    size_t use = use_of(c, k);
    if (l->bad[k] && isnan(l->last[k])) return failed(c, "PV %s is %g; it has not been read yet", name, pv[k]);
    l->bridged[k] = l->bad[k] && (l->gone[k] - 1) * c->period_s < l->bridge_s;
    l->shed[k] = l->bad[k] && !l->bridged[k];
    if (l->shed[k] && l->critical[k]) return failed(c, "PV %s is %g; the loop needs this PV", name, pv[k]);
    if (l->shed[k] && use == c->n_in[OPERATE]) return failed(c, "PV %s is %g; the law cannot leave this PV out", name, pv[k]);
    if (l->shed[k] && first == n) first = k;
    bool wanted = use < c->n_in[OPERATE] && c->operate[use] > 0;
    any = any || wanted;
    left = left || (wanted && !l->shed[k]);
  }
  if (first < n && any && !left)
    return failed(c, "PV %s is %g; no controlled variable is left", c->signals[PV].at[first].name, pv[first]);
  return true;
}

/* A step with bad PVs not fresh, and those that are left out not in use. */
static Outcome loop_step(Loop *l, const double *const given[STATE]) {
  Controller *c = l->c;
  size_t n = c->n_in[PV], m = c->n_in[OPERATE];
  if (!c->uses[FRESH]) return controller_step(c, given);
  memcpy(l->told, c->fresh, n * sizeof *l->told);
  memcpy(l->told + n, c->operate, m * sizeof *l->told);
  for (size_t k = 0; k < n; k++) {
    if (l->bad[k]) c->fresh[k] = 0;
    if (l->shed[k]) c->operate[use_of(c, k)] = 0;
  }
  Outcome outcome = controller_step(c, given);
  memcpy(c->fresh, l->told, n * sizeof *l->told);
  memcpy(c->operate, l->told + n, m * sizeof *l->told);
  return outcome;
}

static void loop_take(Loop *l, const Sample *sample) {
  Controller *c = l->c;
  size_t n = c->n_in[MV];
  bool apart = c->uses[FRESH], good_one = sample && trusted(c, sample, apart ? l->bad : NULL);
  if (!good_one) loop_missed(l, 1);
  else if (apart) good_one = loop_bridge(l, sample->pv);
  loop_found(l, sample ? sample->mv_applied : NULL, good_one);
  memcpy(l->before, l->mv, n * sizeof *l->mv);
  if (l->by_hand && isnan(l->mv[0]) && !l->lost && !l->taken && !(sample && sample->mv_applied) && (good_one || !l->is_read))
    memcpy(l->mv, l->wanted, n * sizeof *l->mv); /* nobody but the operator says where it is */
  if (!good_one) {
    loop_fault(l, sample ? c->words : "the plant cannot be read");
    return;
  }
  if (!sample->mv_applied && !loop_placed(l)) {
    loop_fault(l, "there is no read-back, so where the MV stands is not known and nothing is written");
    return;
  }
  clip(c, sample->mv_applied ? sample->mv_applied : l->mv, l->applied);
  if (!loop_placed(l) || l->mode == SHADOW) memcpy(l->mv, l->applied, n * sizeof *l->mv);
  const double *const given[STATE] = {[SP] = l->sp, [PV] = apart ? l->pv : sample->pv, [DV] = sample->dv, [MV] = l->applied};
  if (loop_step(l, given) != STEPPED) {
    if (l->mode == AUTO) memcpy(l->mv, l->applied, n * sizeof *l->mv);
    loop_fault(l, c->words);
    return;
  }
  if (l->fault && ++l->good == l->recover_after) loop_set_mode(l, AUTO);
  if (l->mode == AUTO) memcpy(l->mv, c->out[OUT_MV], n * sizeof *l->mv);
  if (!l->fault) l->reason[0] = 0;
}

/* One period: l->mv is what to write if loop_writes, l->mode and l->reason say why. sample NULL: the plant cannot be
   read. */
static void loop_scan(Loop *l, const Sample *sample) {
  loop_take(l, sample);
  if (l->by_hand && loop_writes(l)) loop_by_hand(l);
  l->hand = l->mode == MANUAL;
}

#ifndef LOOPWRIGHT_NO_MAIN
/* ------------------------------------------------------------------ the plant: put yours here */
typedef struct {
  const Controller *c;
  double *pv, *dv, *mv;
  int k;
} Plant;

/* Read PVs, disturbances and the MV that the plant received; false if you cannot. Here the PVs wander over their ranges. */
static bool plant_read(Plant *p, Sample *sample) {
  double at = p->k++ % 10 / 10.0;
  for (size_t i = 0; i < p->c->n_in[PV]; i++) {
    const Signal *s = &p->c->signals[PV].at[i];
    p->pv[i] = s->low + (s->high - s->low) * at;
  }
  for (size_t i = 0; i < p->c->n_in[DV]; i++) p->dv[i] = middle(&p->c->signals[DV].at[i]);
  *sample = (Sample){p->pv, p->dv, p->mv, 0.0};
  return true;
}

static bool plant_write(Plant *p, const double *mv) {
  memcpy(p->mv, mv, p->c->n_in[MV] * sizeof *mv);
  return true;
}

/* ------------------------------------------------------------------ an absolute time grid */
static double seconds(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

static void sleep_until(double at) {
  struct timespec until = {.tv_sec = (time_t)at};
  until.tv_nsec = (long)(1e9 * (at - (double)until.tv_sec));
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL) == EINTR) {
  }
}

/* Take NAME=VALUE of operate, all together: each must be allowed beside the others. */
static bool operate_words(Controller *c, char **words, int n) {
  double *values = calloc(c->n_in[OPERATE] + 1, sizeof *values);
  bool known = values || failed(c, "no memory");
  if (known) memcpy(values, c->operate, c->n_in[OPERATE] * sizeof *values);
  for (int k = 0; known && k < n; k++) {
    char name[WORDS], *sign = strrchr(words[k], '='), *end = NULL;
    snprintf(name, sizeof name, "%.*s", sign ? (int)(sign - words[k]) : 0, words[k]);
    size_t i = operate_place(c, name);
    double value = sign ? strtod(sign + 1, &end) : NAN;
    if (!sign || end == sign + 1 || *end) known = failed(c, "%.200s is not NAME=VALUE", words[k]);
    else if (i == c->n_in[OPERATE]) known = failed(c, "operate has no entry %.200s", name);
    else values[i] = value;
  }
  known = known && controller_operate(c, values);
  free(values);
  return known;
}

/* Scan at start + k period: lateness never becomes drift, and a period that has passed whole is skipped. */
static int control(const char *path, long scans, double period, char **words, int n_words) {
  Controller c;
  Loop loop = {0};
  int status = 2;
  if (!controller_open(&c, path) || !operate_words(&c, words, n_words) || !loop_open(&loop, &c, AUTO, 5)) {
    fprintf(stderr, "error: %s\n", c.words);
  } else {
    Plant plant = {&c, calloc(c.n_in[PV] + 1, sizeof(double)), calloc(c.n_in[DV] + 1, sizeof(double)),
                   calloc(c.n_in[MV] + 1, sizeof(double)), 0};
    for (size_t i = 0; i < c.n_in[MV]; i++) plant.mv[i] = middle(&c.signals[MV].at[i]); /* where its actuators stand */
    if (period <= 0) period = c.period_s;
    double start = seconds();
    for (long k = 0; k < scans; k++) {
      sleep_until(start + (double)k * period);
      double late = fmax(0, seconds() - (start + (double)k * period)), missed = floor(late / period);
      if (missed > 0) {
        loop_gap(&loop, missed);
        k += (long)missed;
        late -= missed * period;
      }
      Sample sample;
      loop_scan(&loop, plant_read(&plant, &sample) ? &sample : NULL);
      if (loop_writes(&loop) && !plant_write(&plant, loop.mv)) loop_unwritten(&loop, "the plant cannot be written");
      printf("%ld %.2f ms late %s", k, 1e3 * late, MODE[loop.mode]);
      for (size_t i = 0; loop_writes(&loop) && i < c.n_in[MV]; i++) printf(" %.17g", loop.mv[i]);
      printf("%s %s\n", loop_writes(&loop) ? "" : " -", loop.reason);
    }
    free(plant.pv);
    free(plant.dv);
    free(plant.mv);
    status = 0;
  }
  loop_close(&loop);
  controller_close(&c);
  return status;
}

/* ------------------------------------------------------------------ the conformance kit */
typedef enum { ONE_STEP, CHAINED, RUNS } Run; /* each step from the state that the kit gives; from our own last one */

typedef struct {
  double largest[RUNS];
  int wrong;
  size_t n_us;
  double *us;
} Tally;

/* n hexadecimal floats of a list; NULL if it is none of that length. */
static double *numbers(const Json *list, size_t n, double *to) {
  if (!list || list->kind != J_LIST || list->n != n) return NULL;
  for (size_t i = 0; i < n; i++) to[i] = json_number(&list->items[i]);
  return to;
}

static void compare(Tally *t, Run run, const Json *scale, const Json *wanted, const char *name, const double *ours, size_t n) {
  const Json *theirs = json_get(wanted, name), *of = json_get(scale, name);
  for (size_t i = 0; theirs && of && i < n && i < theirs->n && i < of->n; i++) {
    double share = fabs(ours[i] - json_number(&theirs->items[i])) / json_number(&of->items[i]);
    t->largest[run] = share <= t->largest[run] ? t->largest[run] : isnan(share) ? INFINITY : share;
  }
}

static void put(FILE *out, const char *name, const double *values, size_t n, const char *after) {
  if (!out) return;
  fprintf(out, "\"%s\": [", name);
  for (size_t i = 0; i < n; i++) fprintf(out, "%s\"%a\"", i ? ", " : "", values[i]);
  fprintf(out, "]%s", after);
}

static bool kit_step(Controller *c, Run run, const Json *row, const Json *scale, double *room[INPUTS], FILE *out, Tally *t) {
  const double *given[STATE] = {0};
  for (int i = 0; i < STATE; i++)
    if (c->uses[i] && !(given[i] = numbers(json_get(json_get(row, "given"), INPUT[i]), c->n_in[i], room[i])))
      return failed(c, "a step of the kit lacks %s", INPUT[i]);
  const Json *begins = json_get(row, "begins");
  bool begin = run == ONE_STEP || (begins && begins->kind == J_TRUE);
  if (begin && !numbers(json_get(json_get(row, "given"), "state"), c->n_in[STATE], c->state))
    return failed(c, "a step of the kit lacks its state");
  if (c->uses[OPERATE]) {
    const double *values = numbers(json_get(json_get(row, "given"), "operate"), c->n_in[OPERATE], room[OPERATE]);
    if (!values) return failed(c, "a step of the kit lacks operate");
    if (!controller_operate(c, values)) return false;
  }
  if (c->uses[FRESH] && !numbers(json_get(json_get(row, "given"), "fresh"), c->n_in[FRESH], c->fresh))
    return failed(c, "a step of the kit lacks fresh");
  if (c->uses[AHEAD] && !numbers(json_get(json_get(row, "given"), "ahead"), c->n_in[AHEAD], c->ahead))
    return failed(c, "a step of the kit lacks ahead");
  static const char *const BECAUSE[] = {"", "input", "output"};
  double began = seconds();
  Outcome outcome = controller_step(c, given);
  if (outcome == STEPPED) t->us[t->n_us++] = 1e6 * (seconds() - began);
  t->wrong += strcmp(BECAUSE[outcome], json_word(row, "refused")) != 0;
  if (outcome != STEPPED) {
    if (out) fprintf(out, "{\"refused\": \"%s\"}", BECAUSE[outcome]);
    return true;
  }
  if (out) fprintf(out, "{");
  for (int i = 0; i < OUTPUTS; i++) {
    compare(t, run, scale, json_get(row, "gives"), OUTPUT[i], c->out[i], c->n_out[i]);
    put(out, OUTPUT[i], c->out[i], c->n_out[i], i + 1 < OUTPUTS ? ", " : "}");
  }
  return true;
}

static bool kit_scan(Loop *l, const Json *row, const Json *scale, double *room[INPUTS], FILE *out, Tally *t) {
  Controller *c = l->c;
  const Json *given = json_get(row, "sample");
  for (int i = 0; i < MODES; i++)
    if (!strcmp(json_word(row, "set_mode"), MODE[i])) loop_set_mode(l, (Mode)i);
  const double *by_hand = numbers(json_get(row, "set_mv"), c->n_in[MV], room[MV]);
  if (by_hand) loop_set(l, MV, by_hand); /* it may have to be refused */
  const Json *unwritten = json_get(row, "unwritten"); /* the command of the scan before did not arrive */
  if (unwritten && unwritten->kind == J_TRUE) loop_unwritten(l, "the plant cannot be written");
  double missed = json_number(json_get(row, "missed"));
  if (missed > 0) loop_gap(l, missed);
  Sample sample = {.pv = numbers(json_get(given, "pv"), c->n_in[PV], room[PV]),
                   .dv = numbers(json_get(given, "dv"), c->n_in[DV], room[DV]),
                   .mv_applied = numbers(json_get(given, "mv_applied"), c->n_in[MV], room[MV]),
                   .age_s = json_number(json_get(given, "age_s"))};
  bool read = given && given->kind == J_OBJECT;
  if (read && (!sample.pv || !sample.dv)) return failed(c, "a scan of the kit lacks pv or dv");
  loop_scan(l, read ? &sample : NULL);
  const Json *fault = json_get(row, "fault"), *mv = json_get(row, "mv");
  bool faulty = l->reason[0] != 0, silent = mv && mv->kind == J_NULL; /* nothing may be written */
  t->wrong += strcmp(MODE[l->mode], json_word(row, "mode")) != 0 || !fault || faulty != (fault->kind == J_TRUE) ||
              silent == loop_writes(l);
  if (loop_writes(l)) compare(t, CHAINED, scale, row, "mv", l->mv, c->n_in[MV]);
  if (out) fprintf(out, "{\"mode\": \"%s\", \"fault\": %s, ", MODE[l->mode], faulty ? "true" : "false");
  if (loop_writes(l)) put(out, "mv", l->mv, c->n_in[MV], "}");
  else if (out) fprintf(out, "\"mv\": null}");
  return true;
}

static int by_size(const void *a, const void *b) {
  double x = *(const double *)a, y = *(const double *)b;
  return (x > y) - (x < y);
}

static bool run_kit(Controller *c, Loop *l, const Json *kit, FILE *out, Tally *t) {
  const Json *steps = json_get(kit, "steps"), *scans = json_get(kit, "scans"), *scale = json_get(kit, "scale");
  const Json *begin = json_get(kit, "loop");
  double *room[INPUTS] = {0};
  bool done = steps && scans && steps->kind == J_LIST && scans->kind == J_LIST && steps->n > 0;
  if (!done) failed(c, "the kit has no steps and scans");
  if (done && strcmp(json_word(kit, "sha256"), c->digest))
    done = failed(c, "the kit is of another controller file");
  if (done && !(t->us = calloc(RUNS * steps->n, sizeof *t->us))) done = failed(c, "no memory");
  for (int i = 0; i < INPUTS; i++) {
    room[i] = calloc(c->n_in[i] + 1, sizeof **room);
    if (done && !room[i]) done = failed(c, "no memory");
  }
  const char *version = OrtGetApiBase()->GetVersionString();
  if (out && done)
    fprintf(out, "{\"host\": \"C\", \"onnxruntime\": \"%s\", \"sha256\": \"%s\"", version, json_word(kit, "sha256"));
  for (Run run = ONE_STEP; done && run < RUNS; run++) {
    if (out) fprintf(out, ", \"%s\": [", run == ONE_STEP ? "steps" : "chained");
    for (size_t k = 0; done && k < steps->n; k++) {
      if (out && k) fprintf(out, ",\n");
      done = kit_step(c, run, &steps->items[k], scale, room, out, t);
    }
    if (out) fprintf(out, "]");
  }
  controller_cold(c);
  for (size_t k = 0; k < c->n_in[OPERATE]; k++) c->operate[k] = c->operate_entries[k].standard; /* of all scans */
  for (size_t k = 0; k < c->n_in[FRESH]; k++) c->fresh[k] = 1;
  memset(c->ahead, 0, c->n_in[AHEAD] * sizeof *c->ahead);
  if (done) {
    l->recover_after = (int)json_number(json_get(begin, "recover_after"));
    l->max_gap = json_number(json_get(begin, "max_gap"));
    const double *sp = numbers(json_get(begin, "sp"), c->n_in[SP], room[SP]);
    done = sp ? loop_set(l, SP, sp) : failed(c, "the kit has no start of its loop"); /* nobody tells where the MV stands */
  }
  if (out && done) fprintf(out, ",\n\"scans\": [");
  for (size_t k = 0; done && k < scans->n; k++) {
    if (out && k) fprintf(out, ",\n");
    done = kit_scan(l, &scans->items[k], scale, room, out, t);
  }
  if (t->n_us) qsort(t->us, t->n_us, sizeof *t->us, by_size);
  double p50 = t->n_us ? t->us[t->n_us / 2] : NAN;
  if (out && done) fprintf(out, "], \"p50_us\": %.3f}\n", p50);
  if (done)
    printf("C, onnxruntime %s: %zu steps, %zu scans, largest difference %.3g, chained %.3g, %d wrong, step p50 %.1f us\n",
           version, steps->n, scans->n, t->largest[ONE_STEP], t->largest[CHAINED], t->wrong, p50);
  for (int i = 0; i < INPUTS; i++) free(room[i]);
  free(t->us);
  return done;
}

static int conformance(const char *folder, const char *answers) {
  Controller c = {0};
  Loop loop = {0};
  Tally tally = {0};
  Json kit;
  char path[4096];
  snprintf(path, sizeof path, "%s/vectors.json", folder);
  if (!read_json(path, &kit, c.words)) {
    fprintf(stderr, "error: %s\n", c.words);
    return 2;
  }
  double version = json_number(json_get(&kit, "kit"));
  if (version != 6) {
    fprintf(stderr, "error: the kit has the version %g, not 6: write it again with loopwright conformance FILE.onnx KIT\n", version);
    json_free(&kit);
    return 2;
  }
  snprintf(path, sizeof path, "%s/%s", folder, json_word(&kit, "file"));
  FILE *out = NULL;
  bool done = controller_open(&c, path) && loop_open(&loop, &c, AUTO, 1);
  if (done && answers && !(out = fopen(answers, "w"))) done = failed(&c, "%s cannot be written: %s", answers, strerror(errno));
  done = done && run_kit(&c, &loop, &kit, out, &tally);
  if (out && (ferror(out) | fclose(out))) done = failed(&c, "%s cannot be written", answers);
  if (!done) fprintf(stderr, "error: %s\n", c.words);
  bool passed = done && !tally.wrong && tally.largest[ONE_STEP] <= json_number(json_get(&kit, "tolerance")) &&
                tally.largest[CHAINED] <= json_number(json_get(&kit, "chained_tolerance"));
  loop_close(&loop);
  controller_close(&c);
  json_free(&kit);
  return !done ? 2 : passed ? 0 : 1;
}

int main(int n, char **words) {
  if (n >= 3 && n <= 4 && !strcmp(words[1], "--conformance")) return conformance(words[2], n > 3 ? words[3] : NULL);
  if (n >= 2 && words[1][0] != '-')
    return control(words[1], n > 2 ? strtol(words[2], NULL, 10) : 20, n > 3 ? strtod(words[3], NULL) : 0,
                   n > 4 ? words + 4 : NULL, n > 4 ? n - 4 : 0);
  fprintf(stderr, "usage: host FILE.onnx [SCANS [PERIOD_S [NAME=VALUE ...]]] | host --conformance KIT [ANSWERS.json]\n");
  return 2;
}
#endif

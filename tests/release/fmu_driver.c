/* Plays the steps of a conformance kit through the functions of an FMU, and what fmpy cannot: many instances, states
   and refusals, under the sanitizers. Compiled with -DFMI=2 or 3 beside the FMU's source; test_fmu_memory.py.

     driver RESOURCES TOKEN STEPS: a line a step, "COLD REFUSED" and hexadecimal floats: state, inputs, then mv and info */
#if FMI == 2
#include "fmi2.c"
#define F(Name) fmi2##Name
#define SET_REAL(i, vr, x) fmi2SetReal(i, vr, 1, x)
#define GET_REAL(i, vr, x) fmi2GetReal(i, vr, 1, x)
typedef fmi2ValueReference Reference;
typedef fmi2Boolean Boolean;
typedef fmi2Byte Byte;
typedef fmi2FMUstate State;
#define GET_STATE fmi2GetFMUstate
#define SET_STATE fmi2SetFMUstate
#define FREE_STATE fmi2FreeFMUstate
#define STATE_SIZE fmi2SerializedFMUstateSize
#define WRITE_STATE fmi2SerializeFMUstate
#define READ_STATE fmi2DeSerializeFMUstate
#else
#include "fmi3.c"
#define F(Name) fmi3##Name
#define SET_REAL(i, vr, x) fmi3SetFloat64(i, vr, 1, x, 1)
#define GET_REAL(i, vr, x) fmi3GetFloat64(i, vr, 1, x, 1)
typedef fmi3ValueReference Reference;
typedef fmi3Boolean Boolean;
typedef fmi3Byte Byte;
typedef fmi3FMUState State;
#define GET_STATE fmi3GetFMUState
#define SET_STATE fmi3SetFMUState
#define FREE_STATE fmi3FreeFMUState
#define STATE_SIZE fmi3SerializedFMUStateSize
#define WRITE_STATE fmi3SerializeFMUState
#define READ_STATE fmi3DeserializeFMUState
#endif

#include <locale.h>

#ifdef LAW_SHA256
enum { READS_FILES = 0 };
#else
enum { READS_FILES = 1 };
#endif

static int said;

#define NEED(what)                                                     \
  do {                                                                 \
    if (!(what)) {                                                     \
      fprintf(stderr, "line %d: %s does not hold\n", __LINE__, #what); \
      exit(1);                                                         \
    }                                                                  \
  } while (0)

#if FMI == 2
static void hear(fmi2ComponentEnvironment e, fmi2String name, fmi2Status status, fmi2String category, fmi2String words,
                 ...) {
  (void)name, (void)status, (void)category;
  said += *(int *)e * (words[0] != 0);
}

static void *instantiate(const char *resources, const char *token) {
  static int one = 1;
  fmi2CallbackFunctions functions = {hear, NULL, NULL, NULL, &one}; /* gone after this call, as some tools do */
  char uri[4096];
  snprintf(uri, sizeof uri, "file://%s", resources);
  return fmi2Instantiate("driver", fmi2CoSimulation, token, uri, &functions, fmi2False, fmi2True);
}

/* Percent signs with two digits, fewer, or none behind them. Each URI lies in memory of its own, so that the sanitizer sees
   a step beyond its end; the path must fit the memory that the URI's length gives. */
static void uris(void) {
  static const char *const URI[][2] = {
      {"file:///a%20b", "/a b"},     {"file:/a%2fb%2Fc%7E", "/a/b/c~"}, {"file://host/a%25b", "/a%b"},
      {"file:///a%5", "/a%5"},       {"file:///a%", "/a%"},             {"file:///a%%", "/a%%"},
      {"file:///%5", "/%5"},         {"file:///a%zz", "/a%zz"},         {"file:///a%5gb", "/a%5gb"},
      {"file:///a% 5b", "/a% 5b"},   {"file:///a%+5b", "/a%+5b"},       {"file:///a%0x", "/a%0x"},
      {"file:///a%c3%A4", "/a\xc3\xa4"}, {"file:", ""},                   {"file://host", ""},
      {"/plain%20path", "/plain%20path"}};
  for (size_t k = 0; k < sizeof URI / sizeof *URI; k++) {
    char *uri = strdup(URI[k][0]), *path = NULL;
    NEED(uri && path_of(uri, &path));
    if (strcmp(path, URI[k][1])) fprintf(stderr, "%s gave %s\n", uri, path);
    NEED(!strcmp(path, URI[k][1]));
    free(path);
    free(uri);
  }
}

static void begin(void *i) {
  NEED(fmi2SetupExperiment(i, fmi2False, 0, 0, fmi2False, 0) == fmi2OK);
  NEED(fmi2EnterInitializationMode(i) == fmi2OK && fmi2ExitInitializationMode(i) == fmi2OK);
}

static int step(void *i, double at, double h) { return fmi2DoStep(i, at, h, fmi2True); }
static int get_boolean_of(void *i, Reference vr, Boolean *x) { return fmi2GetBoolean(i, &vr, 1, x); }
#else
static void hear(fmi3InstanceEnvironment e, fmi3Status status, fmi3String category, fmi3String words) {
  (void)status, (void)category;
  said += *(int *)e * (words[0] != 0);
}

static void *instantiate(const char *resources, const char *token) {
  static int one = 1;
  return fmi3InstantiateCoSimulation("driver", token, resources, false, true, false, false, NULL, 0, &one, hear, NULL);
}

static void uris(void) {} /* FMI 3.0 gives a path */

static void begin(void *i) {
  NEED(fmi3EnterInitializationMode(i, false, 0, 0, false, 0) == fmi3OK && fmi3ExitInitializationMode(i) == fmi3OK);
}

static int step(void *i, double at, double h) {
  fmi3Boolean event, end, early;
  double reached;
  return fmi3DoStep(i, at, h, true, &event, &end, &early, &reached);
}
static int get_boolean_of(void *i, Reference vr, Boolean *x) { return fmi3GetBoolean(i, &vr, 1, x, 1); }
#endif

/* The worst status of n calls: 0 where all are well. */
static int set(void *i, Reference first, size_t n, double *x) {
  int worst = 0;
  for (size_t k = 0; k < n; k++) {
    Reference vr = first + (Reference)k;
    int status = (int)SET_REAL(i, &vr, x + k);
    worst = status > worst ? status : worst;
  }
  return worst;
}

static int get(void *i, Reference first, size_t n, double *x) {
  int worst = 0;
  for (size_t k = 0; k < n; k++) {
    Reference vr = first + (Reference)k;
    int status = (int)GET_REAL(i, &vr, x + k);
    worst = status > worst ? status : worst;
  }
  return worst;
}

/* Bytes of a state with one number changed: refused, and the instance as it was. */
static void forge(void *i, const Byte *bytes, size_t size, size_t entry, double value) {
  Byte *forged = malloc(size + 1), *before = malloc(size);
  State state = NULL, other = NULL;
  NEED(forged && before && GET_STATE(i, &state) == 0 && WRITE_STATE(i, state, before, size) == 0);
  memcpy(forged + 1, bytes, size); /* at an odd address */
  memcpy(forged + 1 + sizeof(Saved) + entry * sizeof value, &value, sizeof value);
  NEED(READ_STATE(i, forged + 1, size, &other) != 0 && !other);
  NEED(READ_STATE(i, bytes, size, &other) == 0 && other);
  ((Saved *)other)->numbers[entry] = value; /* and past the bytes */
  NEED(SET_STATE(i, other) != 0);
  NEED(GET_STATE(i, &state) == 0 && WRITE_STATE(i, state, forged, size) == 0 && !memcmp(forged, before, size));
  NEED(FREE_STATE(i, &state) == 0 && FREE_STATE(i, &other) == 0);
  free(forged);
  free(before);
}

static void forgeries(void *i, const Byte *bytes, size_t size) {
  const Instance *in = i;
  double high = in->c.signals[MV].at[0].high, low = in->c.signals[MV].at[0].low;
  const double bad[] = {NAN, INFINITY, -INFINITY, high + (high - low), low - 1e-9 * (high - low)};
  for (size_t k = 0; k < sizeof bad / sizeof *bad; k++) {
    forge(i, bytes, size, in->at[G_MV], bad[k]);
    forge(i, bytes, size, in->at[G_START], bad[k]);
  }
  for (size_t k = 0; k < 3; k++) {
    if (in->n[G_INFO]) forge(i, bytes, size, in->at[G_INFO], bad[k]);
    if (in->c.n_in[STATE]) forge(i, bytes, size, in->n_memory - 1, bad[k]);
    for (int entry = PHASE; entry < OWN; entry++) forge(i, bytes, size, (size_t)entry, bad[k]);
  }
  forge(i, bytes, size, SAMPLES, in->memory[SAMPLES] + 0.5);
  forge(i, bytes, size, SAMPLES, -9e15);
  forge(i, bytes, size, PHASE, INSTANTIATED);
  forge(i, bytes, size, FAULT, 2);
}

/* The state through bytes into this and another instance, and back. */
static void carry(void *i, void *other) {
  State state = NULL, copy = NULL;
  size_t size = 0;
  NEED(GET_STATE(i, &state) == 0 && GET_STATE(i, &state) == 0); /* the second time into the same memory */
  NEED(STATE_SIZE(i, state, &size) == 0 && size > 0);
  Byte *bytes = malloc(size);
  NEED(bytes && WRITE_STATE(i, state, bytes, size) == 0);
  NEED(WRITE_STATE(i, state, bytes, size - 1) != 0);
  NEED(READ_STATE(other, bytes, size, &copy) == 0 && SET_STATE(other, copy) == 0);
  if (((Instance *)i)->memory[SAMPLES] > 0) forgeries(other, bytes, size);
  bytes[0] ^= 1;
  NEED(READ_STATE(other, bytes, size, &copy) != 0 && READ_STATE(other, bytes, size - 8, &copy) != 0);
  NEED(SET_STATE(i, state) == 0);
  NEED(FREE_STATE(i, &state) == 0 && !state && FREE_STATE(i, &state) == 0 && FREE_STATE(other, &copy) == 0);
  NEED(SET_STATE(i, NULL) != 0);
  free(bytes);
}

int main(int n, char **words) {
  NEED(n == 4);
  const char *locale = getenv("DRIVER_LOCALE"); /* of the program around an FMU, as some set it */
  NEED(!locale || (setlocale(LC_NUMERIC, locale) && strtod("0,5", NULL) == 0.5));
  NEED(!instantiate(words[1], "{wrong}") && (!READS_FILES || !instantiate("/nowhere", words[2])) && said == 1 + READS_FILES);
  void *i = instantiate(words[1], words[2]), *other = instantiate(words[1], words[2]);
  NEED(i && other);
  NEED(!locale || strtod("0,5", NULL) == 0.5); /* and it is as it was */
  setlocale(LC_NUMERIC, "C");
  uris();
  begin(other);
  const Instance *in = i;
  size_t n_in = in->at[G_START] - in->at[G_SP], n_out = in->n[G_MV] + in->n[G_INFO];
  Reference first_out = VR_FIRST + (Reference)(in->at[G_MV] - OWN);
  double state[256], given[256], wanted[256], found[256], period = in->c.period_s;
  size_t n_state = in->c.n_in[STATE];
  NEED(n_state < 256 && n_in < 256 && n_out < 256);
  FILE *steps = fopen(words[3], "r");
  NEED(steps);
  int cold, refused, played = 0, k = 0, before = said;
  while (fscanf(steps, "%d %d", &cold, &refused) == 2) {
    for (size_t j = 0; j < n_state + n_in + n_out; j++) {
      char text[64];
      NEED(fscanf(steps, "%63s", text) == 1);
      *(j < n_state ? &state[j] : j < n_state + n_in ? &given[j - n_state] : &wanted[j - n_state - n_in]) = strtod(text, NULL);
    }
    if (cold) {
      NEED(F(Reset)(i) == 0);
      begin(i);
      k = 0;
    }
    memcpy(((Instance *)i)->c.state, state, n_state * sizeof *state);
    NEED(set(i, VR_FIRST, n_in, given) == 0 && step(i, k * period, period) == 0);
    k++;
    NEED(get(i, first_out, n_out, found) == 0 && !memcmp(found, wanted, n_out * sizeof *found));
    Boolean fault;
    NEED(get_boolean_of(i, VR_FAULT, &fault) == 0 && !fault == !refused);
    NEED(said == (before += refused));
    if (played++ % 50 == 0) carry(i, other);
    before = said; /* refusals of states are told, too */
  }
  fclose(steps);
  NEED(get(i, first_out + (Reference)n_out, 1, found) != 0 && get(i, 4000000000u, 1, found) != 0);
  NEED(set(i, first_out, 1, found) != 0 && set(i, VR_TIME, 1, found) != 0);
  NEED(F(Terminate)(i) == 0 && step(i, k * period, period) != 0);
  F(FreeInstance)(i);
#ifndef LEAK
  F(FreeInstance)(other);
#endif
  other = i = NULL;
  F(FreeInstance)(NULL);
  printf("%d steps\n", played);
  return 0;
}

/* The functions of FMI 2.0 for co-simulation around instance.c. */
#include "instance.c"

#include "fmi2Functions.h"

#define STATUS(done) ((done) ? fmi2OK : fmi2Error)

typedef struct {
  fmi2CallbackLogger logger;
  fmi2ComponentEnvironment environment;
} Listener;

static void tell(const Instance *i, int status, const char *category, const char *words) {
  const Listener *to = i->environment;
  if (!to->logger) return;
  /* The words are a format, which a logger that knows no variable arguments can print too: %% is a percent sign. */
  char format[2 * sizeof i->words], *at = format;
  for (; *words; words++) {
    if (*words == '%') *at++ = '%';
    *at++ = *words;
  }
  *at = 0;
  to->logger(to->environment, i->name ? i->name : "", (fmi2Status)status, category, format);
}

static int hex_digit(char c) {
  const char *digits = "0123456789abcdef0123456789ABCDEF", *at = c ? strchr(digits, c) : NULL;
  return at ? (int)(at - digits) % 16 : -1;
}

/* The path in a URI file:///..., file:/... or file://host/...; anything else is taken for a path. A percent sign without
   two hexadecimal digits behind it stands for itself. false: no memory. */
static bool path_of(const char *uri, char **path) {
  if (!strncmp(uri, "file:", 5)) {
    uri += 5;
    if (!strncmp(uri, "//", 2)) uri += 2 + strcspn(uri + 2, "/");
  } else {
    return (*path = strdup(uri)) != NULL;
  }
  char *to = *path = malloc(strlen(uri) + 1);
  while (to && *uri) {
    int high = *uri == '%' ? hex_digit(uri[1]) : -1, low = high < 0 ? -1 : hex_digit(uri[2]);
    *to++ = low < 0 ? *uri : (char)(16 * high + low);
    uri += low < 0 ? 1 : 3;
  }
  if (to) *to = 0;
  return to != NULL;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return "2.0"; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
  (void)visible;
  Listener *listener = calloc(1, sizeof *listener);
  char *path = NULL;
  Instance *made = NULL;
  if (listener && functions) *listener = (Listener){functions->logger, functions->componentEnvironment};
  if (listener && type == fmi2CoSimulation && path_of(resources ? resources : "", &path))
    made = instance_new(name, guid, path, listener, tell, logging != fmi2False);
  free(path);
  if (!made) free(listener);
  return made;
}

void fmi2FreeInstance(fmi2Component c) {
  if (!c) return;
  free(((Instance *)c)->environment);
  instance_free(c);
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
  bool named = n == 0;
  for (size_t k = 0; k < n; k++) named = named || !strcmp(categories[k], "logStatusWarning");
  ((Instance *)c)->logs_warnings = on != fmi2False && named;
  return fmi2OK;
}

/* ------------------------------------------------------------------ begin, end */
fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean with_tolerance, fmi2Real tolerance, fmi2Real start,
                               fmi2Boolean with_stop, fmi2Real stop) {
  (void)with_tolerance, (void)tolerance, (void)with_stop, (void)stop;
  Instance *i = c;
  if (i->memory[PHASE] != INSTANTIATED) return STATUS(REFUSE(i, "an experiment is set up before its initialization"));
  i->memory[BEGINS] = start;
  return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  return STATUS(instance_begin(c, ((Instance *)c)->memory[BEGINS]));
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return STATUS(instance_begun(c)); }

fmi2Status fmi2Terminate(fmi2Component c) {
  instance_end(c);
  return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
  instance_reset(c);
  return fmi2OK;
}

/* ------------------------------------------------------------------ variables */
fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
  bool done = true;
  for (size_t k = 0; done && k < n; k++) done = get_real(c, vr[k], &value[k]);
  return STATUS(done);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
  bool done = true;
  for (size_t k = 0; done && k < n; k++) done = set_real(c, vr[k], value[k]);
  return STATUS(done);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[]) {
  bool done = true, found = false;
  for (size_t k = 0; done && k < n; k++) {
    done = get_boolean(c, vr[k], &found);
    value[k] = found ? fmi2True : fmi2False;
  }
  return STATUS(done);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[]) {
  bool done = true;
  for (size_t k = 0; done && k < n; k++) done = set_boolean(c, vr[k], value[k] != fmi2False);
  return STATUS(done);
}

#define NO_VARIABLE(Type)                                                                                              \
  fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2##Type value[]) {             \
    (void)vr, (void)value;                                                                                             \
    return STATUS(!n || REFUSE((Instance *)c, "there is no variable of type " #Type));                                 \
  }                                                                                                                    \
  fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2##Type value[]) {       \
    (void)vr, (void)value;                                                                                             \
    return STATUS(!n || REFUSE((Instance *)c, "there is no variable of type " #Type));                                 \
  }
NO_VARIABLE(Integer)
NO_VARIABLE(String)

/* ------------------------------------------------------------------ states */
fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) { return STATUS(instance_save(c, (Saved **)state)); }
fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) { return STATUS(instance_restore(c, state)); }

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
  (void)c;
  if (!state) return fmi2OK;
  free(*state);
  *state = NULL;
  return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
  (void)state;
  *size = saved_size(c);
  return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
  return STATUS(instance_write(c, state, bytes, size));
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
  return STATUS(instance_read(c, bytes, size, (Saved **)state));
}

/* ------------------------------------------------------------------ steps */
fmi2Status fmi2DoStep(fmi2Component c, fmi2Real from, fmi2Real length, fmi2Boolean no_going_back) {
  (void)no_going_back;
  return STATUS(instance_step(c, from, length));
}

fmi2Status fmi2CancelStep(fmi2Component c) { return STATUS(REFUSE((Instance *)c, "no step is under way")); }

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
  if (kind != fmi2LastSuccessfulTime) return fmi2Discard;
  *value = ((Instance *)c)->memory[NOW];
  return fmi2OK;
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
  (void)c;
  if (kind != fmi2Terminated) return fmi2Discard;
  *value = fmi2False;
  return fmi2OK;
}

/* ------------------------------------------------------------------ what this FMU does not do */
#define NO_STATUS(Name, Type)                                                                                          \
  fmi2Status fmi2Get##Name(fmi2Component c, const fmi2StatusKind kind, Type *value) {                                  \
    (void)c, (void)kind, (void)value;                                                                                  \
    return fmi2Discard;                                                                                                \
  }
NO_STATUS(Status, fmi2Status)
NO_STATUS(IntegerStatus, fmi2Integer)
NO_STATUS(StringStatus, fmi2String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t n,
                                        const fmi2ValueReference known[], size_t m, const fmi2Real by[],
                                        fmi2Real value[]) {
  (void)unknown, (void)n, (void)known, (void)m, (void)by, (void)value;
  return STATUS(REFUSE((Instance *)c, "this FMU has no derivatives"));
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[]) {
  (void)vr, (void)n, (void)order, (void)value;
  return STATUS(REFUSE((Instance *)c, "inputs are held over a step, not interpolated"));
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[]) {
  (void)vr, (void)n, (void)order, (void)value;
  return STATUS(REFUSE((Instance *)c, "outputs are held, so they have no derivatives"));
}

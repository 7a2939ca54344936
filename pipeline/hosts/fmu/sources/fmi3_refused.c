/* Functions that FMI 3.0's header declares and a controller has no use for: each refuses. Included by fmi3.c. */
#pragma GCC diagnostic ignored "-Wunused-parameter"

#define REFUSED(Name, ...)                                                                                             \
  fmi3Status fmi3##Name(__VA_ARGS__) { return STATUS(REFUSE((Instance *)i, "this FMU has no use for fmi3" #Name)); }

#define NO_VARIABLE(Type)                                                                                              \
  fmi3Status fmi3Get##Type(fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3##Type value[], size_t m) {    \
    return STATUS(!n || REFUSE((Instance *)i, "there is no variable of type " #Type));                                 \
  }                                                                                                                    \
  fmi3Status fmi3Set##Type(fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3##Type value[],          \
                           size_t m) {                                                                                 \
    return STATUS(!n || REFUSE((Instance *)i, "there is no variable of type " #Type));                                 \
  }

NO_VARIABLE(Float32)
NO_VARIABLE(Int8)
NO_VARIABLE(UInt8)
NO_VARIABLE(Int16)
NO_VARIABLE(UInt16)
NO_VARIABLE(Int32)
NO_VARIABLE(UInt32)
NO_VARIABLE(Int64)
NO_VARIABLE(UInt64)
NO_VARIABLE(String)

/* Without an event mode a simulation is in step mode after its initialization. */
fmi3Status fmi3EnterStepMode(fmi3Instance i) { return STATUS(((Instance *)i)->memory[PHASE] == STEPPING); }

#define NO_INSTANCE(Name, ...)                                                                                         \
  fmi3Instance fmi3Instantiate##Name(__VA_ARGS__) {                                                                    \
    if (say) say(environment, fmi3Error, "logStatusError", "this FMU is for co-simulation");                           \
    return NULL;                                                                                                       \
  }

NO_INSTANCE(ModelExchange, fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
        fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback say)
NO_INSTANCE(ScheduledExecution, fmi3String name, fmi3String token, fmi3String path, fmi3Boolean visible,
        fmi3Boolean logging, fmi3InstanceEnvironment environment, fmi3LogMessageCallback say,
        fmi3ClockUpdateCallback update, fmi3LockPreemptionCallback lock, fmi3UnlockPreemptionCallback unlock)
REFUSED(EnterEventMode, fmi3Instance i)
REFUSED(GetBinary, fmi3Instance i, const fmi3ValueReference vr[], size_t n, size_t size[], fmi3Binary value[],
        size_t m)
REFUSED(GetClock, fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3Clock value[])
REFUSED(SetBinary, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const size_t size[],
        const fmi3Binary value[], size_t m)
REFUSED(SetClock, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3Clock value[])
REFUSED(GetNumberOfVariableDependencies, fmi3Instance i, fmi3ValueReference vr, size_t *n)
REFUSED(GetVariableDependencies, fmi3Instance i, fmi3ValueReference dependent, size_t at[], fmi3ValueReference by[],
        size_t on[], fmi3DependencyKind kind[], size_t n)
REFUSED(GetDirectionalDerivative, fmi3Instance i, const fmi3ValueReference u[], size_t nu,
        const fmi3ValueReference k[], size_t nk, const fmi3Float64 seed[], size_t ns, fmi3Float64 d[], size_t nd)
REFUSED(GetAdjointDerivative, fmi3Instance i, const fmi3ValueReference u[], size_t nu, const fmi3ValueReference k[],
        size_t nk, const fmi3Float64 seed[], size_t ns, fmi3Float64 d[], size_t nd)
REFUSED(EnterConfigurationMode, fmi3Instance i)
REFUSED(ExitConfigurationMode, fmi3Instance i)
REFUSED(GetIntervalDecimal, fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[],
        fmi3IntervalQualifier q[])
REFUSED(GetIntervalFraction, fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3UInt64 count[],
        fmi3UInt64 of[], fmi3IntervalQualifier q[])
REFUSED(GetShiftDecimal, fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[])
REFUSED(GetShiftFraction, fmi3Instance i, const fmi3ValueReference vr[], size_t n, fmi3UInt64 count[],
        fmi3UInt64 of[])
REFUSED(SetIntervalDecimal, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[])
REFUSED(SetIntervalFraction, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 count[],
        const fmi3UInt64 of[])
REFUSED(SetShiftDecimal, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[])
REFUSED(SetShiftFraction, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3UInt64 count[],
        const fmi3UInt64 of[])
REFUSED(EvaluateDiscreteStates, fmi3Instance i)
REFUSED(UpdateDiscreteStates, fmi3Instance i, fmi3Boolean *more, fmi3Boolean *end, fmi3Boolean *nominals,
        fmi3Boolean *states, fmi3Boolean *next, fmi3Float64 *at)
REFUSED(EnterContinuousTimeMode, fmi3Instance i)
REFUSED(CompletedIntegratorStep, fmi3Instance i, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *end)
REFUSED(SetTime, fmi3Instance i, fmi3Float64 time)
REFUSED(SetContinuousStates, fmi3Instance i, const fmi3Float64 x[], size_t n)
REFUSED(GetContinuousStateDerivatives, fmi3Instance i, fmi3Float64 dx[], size_t n)
REFUSED(GetEventIndicators, fmi3Instance i, fmi3Float64 z[], size_t n)
REFUSED(GetContinuousStates, fmi3Instance i, fmi3Float64 x[], size_t n)
REFUSED(GetNominalsOfContinuousStates, fmi3Instance i, fmi3Float64 x[], size_t n)
REFUSED(GetNumberOfEventIndicators, fmi3Instance i, size_t *n)
REFUSED(GetNumberOfContinuousStates, fmi3Instance i, size_t *n)
REFUSED(GetOutputDerivatives, fmi3Instance i, const fmi3ValueReference vr[], size_t n, const fmi3Int32 order[],
        fmi3Float64 value[], size_t m)
REFUSED(ActivateModelPartition, fmi3Instance i, fmi3ValueReference clock, fmi3Float64 at)
